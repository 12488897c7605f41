"""Trained policies from the folder of a run, finished or still running."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from envs_jax import Environment
from hmasd_jax.config import TrainConfig, build, to_json
from hmasd_jax.hmasd.config import count_skills
from hmasd_jax.runs.checkpoint import restore, state_template
from hmasd_jax.runs.folder import RunError, checkpoint_folder, read_config, seeds_of
from hmasd_jax.types import Algorithm, Policy


class TrainedRun(NamedTuple):
    """One seed of a run at a checkpoint."""

    config: TrainConfig
    """Configuration of the run."""
    env: Environment
    """Environment that `config` describes."""
    algorithm: Algorithm
    """Algorithm that `config` describes."""
    state: Any
    """The whole train state."""
    env_steps: int
    """Environment steps done at the checkpoint."""


def load_run(run: Path | str, seed: int = 0, step: int | None = None) -> TrainedRun:
    """Load the train state of a run, and build its environment and algorithm.

    Args:
        run: Folder of the run.
        seed: Index of the seed in the run.
        step: Environment steps of the checkpoint; None selects the newest.

    Raises:
        RunError: `run` is not the folder of a run, or has no such seed.
        ConfigError: The configuration of the run is not valid in this version.
        CheckpointError: There is no such checkpoint, or it is damaged.
    """
    run = Path(run)
    config = read_config(run)
    seeds = seeds_of(run)
    if seed not in seeds:
        known = ", ".join(map(str, seeds))
        raise RunError(f"{run} has no seed {seed}" + (f", but {known}" if seeds else " yet"))
    env, algorithm = build(config)
    folder = checkpoint_folder(run, seed)
    state, env_steps = restore(folder, state_template(algorithm), to_json(config), step)
    return TrainedRun(config=config, env=env, algorithm=algorithm, state=state, env_steps=env_steps)


def load_policy(
    run: Path | str,
    seed: int = 0,
    step: int | None = None,
    greedy: bool = True,
    skills: Sequence[int | None] | None = None,
) -> Policy:
    """Load the policy of a run as a pair of pure functions.

    Example:
        >>> policy = hmasd_jax.load_policy("runs/alice_and_bob")  # doctest: +SKIP
        >>> metrics = evaluate(env, policy, jax.random.key(0), num_episodes=100)  # doctest: +SKIP

    Args:
        run: Folder of the run, finished or still running.
        seed: Index of the seed in the run.
        step: Environment steps of the checkpoint; None selects the newest.
        greedy: If True, act by arg-max as in the paper's evaluation; else sample.
        skills: Skills to follow, (Z, z^1, .., z^N). The coordinator chooses those that are None.
            Only for algorithms with skills.

    Raises:
        RunError: `run` is not the folder of a run, or has no such seed. Its algorithm has no
            skills, the number of skills is wrong, or one does not exist.
        ConfigError: The configuration of the run is not valid in this version.
        CheckpointError: There is no such checkpoint, or it is damaged.
    """
    return make_policy(load_run(run, seed, step), skills, greedy)


def make_policy(
    trained: TrainedRun, skills: Sequence[int | None] | None = None, greedy: bool = True
) -> Policy:
    """Return the policy of a run, which holds the given skills.

    Raises:
        RunError: The algorithm has no skills, their number is wrong, or one does not exist.
    """
    if skills is None:
        return trained.algorithm.policy(trained.state, greedy)
    check_skills(trained)
    try:
        return trained.algorithm.policy(trained.state, greedy, skills=skills)
    except ValueError as error:
        raise RunError(str(error)) from error


def check_skills(trained: TrainedRun) -> None:
    """Check that the algorithm of a run has skills.

    Raises:
        RunError: It has none.
    """
    if not any(count_skills(trained.config.algorithm)):
        name = type(trained.config.algorithm).__name__.removesuffix("Config")
        raise RunError(f"{name} has no skills: choose a run of HMASD, or name no skills")
