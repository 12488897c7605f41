"""Trained policies from the folder of a run, finished or still running."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax

from envs_jax import Environment
from hmasd_jax import config as configs
from hmasd_jax.config import TrainConfig
from hmasd_jax.runs import checkpoint
from hmasd_jax.runs import folder as run_folder
from hmasd_jax.runs.folder import RunError
from hmasd_jax.types import Algorithm, Policy


class TrainedRun(NamedTuple):
    """One seed of a run as it was at a checkpoint."""

    config: TrainConfig
    env: Environment
    algorithm: Algorithm
    state: Any
    """The whole train state."""
    env_steps: int
    """Environment steps done at the checkpoint."""


def load_run(run: Path | str, seed: int = 0, step: int | None = None) -> TrainedRun:
    """Rebuild what a run trained.

    Args:
        run: folder of the run.
        seed: index of the seed in it.
        step: environment steps of the checkpoint; None is the newest.

    Raises:
        RunError: not the folder of a run, or it has no such seed.
        ConfigError: the run's configuration is not valid any more.
        CheckpointError: there is no such checkpoint, or it is damaged.
    """
    run = Path(run)
    config = run_folder.read_config(run)
    seeds = run_folder.seeds_of(run)
    if seed not in seeds:
        known = ", ".join(map(str, seeds)) or "none yet"
        raise RunError(f"{run} has no seed {seed}: there are {known}")
    env, algorithm = configs.build(config)
    template = jax.eval_shape(algorithm.init, jax.random.key(0))
    folder = run_folder.checkpoint_folder(run, seed)
    state, env_steps = checkpoint.restore(folder, template, configs.to_json(config), step)
    return TrainedRun(config, env, algorithm, state, env_steps)


def load_policy(
    run: Path | str,
    seed: int = 0,
    step: int | None = None,
    greedy: bool = True,
    skills: Sequence[int | None] | None = None,
) -> Policy:
    """The policy that a run has trained, as a pair of pure functions.

    Example:
        >>> policy = hmasd_jax.load_policy("runs/alice_and_bob")  # doctest: +SKIP
        >>> metrics = evaluate(env, policy, jax.random.key(0), num_episodes=100)  # doctest: +SKIP

    Args:
        run: folder of the run, finished or still running.
        seed: index of the seed in it.
        step: environment steps of the checkpoint; None is the newest.
        greedy: whether to act by arg-max (the paper's evaluation) or to sample.
        skills: the skills to follow, (Z, z^1, .., z^N), instead of the coordinator's choice; it
            still chooses those that are None. Only for algorithms with skills.

    Raises:
        RunError: not the folder of a run, or it has no such seed.
        ConfigError: the run's configuration is not valid any more.
        CheckpointError: there is no such checkpoint, or it is damaged.
        ValueError: wrong number of skills, or a skill that does not exist.
    """
    trained = load_run(run, seed, step)
    if skills is None:
        return trained.algorithm.policy(trained.state, greedy)
    return trained.algorithm.policy(trained.state, greedy, skills=skills)
