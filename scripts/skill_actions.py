"""Record what the individual skills of a trained run do in a battle.

python scripts/skill_actions.py RUN OUT

Each skill in turn is given to all agents, under team skill 0, and actions are sampled. OUT (JSON)
gets one row per seed and skill: how often living agents take each action where they can attack and
where they cannot, and how the battles end.
"""

from functools import partial
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Key

from envs_jax import Environment
from envs_jax.micro_battle.observations import FIRST_ATTACK
from hmasd_jax.rl.evaluate import first_episode, play
from hmasd_jax.runs import folder as run_folder
from hmasd_jax.runs.load import TrainedRun, load_run
from hmasd_jax.types import Policy, Transition
from scripts.records import describe_script, run_and_out_parser, write_rows

COPIES = 200
ACTIONS = ("stop", "north", "south", "east", "west", "attack")


def measure_skill(trained: TrainedRun, skill: int) -> dict[str, Any]:
    """Play battles in which all agents have `skill`, and summarize them."""
    skills = (0,) + (skill,) * trained.env.num_agents
    policy = trained.algorithm.policy(trained.state, False, skills=skills)
    battles = play_battles(trained.env, policy, jax.random.key(1))
    return summarize(battles, len(trained.env.resolved_scenario.enemies))


def play_battles(env: Environment, policy: Policy, key: Key[Array, ""]) -> Transition:
    """Play a whole battle in each of `COPIES` copies. A copy whose battle ends begins another.

    Returns:
        NumPy arrays of shape (max_steps, COPIES, ...).
    """
    program = jax.jit(partial(play, env, policy, num_episodes=COPIES))
    return jax.device_get(program(key))


def summarize(battles: Transition, num_enemies: int) -> dict[str, Any]:
    """Return the shares of actions and the means over the first battle of each copy.

    Later ones would count short battles more often: only those end before the last step.

    Args:
        battles: arrays of shape (T, E, ...), as `play_battles` returns them.
        num_enemies: enemies at the start of a battle.
    """
    mask, action = battles.timestep.action_mask, battles.action
    counted = np.asarray(first_episode(battles))
    over = counted & battles.outcome.done
    alive, armed = ~mask[..., 0] & counted[..., None], mask[..., FIRST_ATTACK:].any(-1)
    return {
        "episodes": int(over.sum()),
        "wins": float(battles.outcome.info["success"][over].mean()),
        "enemies_killed": float(num_enemies - battles.outcome.info["enemies_alive"][over].mean()),
        "episode_length": float(counted.sum() / over.sum()),
        "share_in_range": float((armed & alive).sum() / alive.sum()),
        "out_of_range": action_shares(action[alive & ~armed]),
        "in_range": action_shares(action[alive & armed]),
    }


def action_shares(actions: np.ndarray) -> dict[str, float]:
    """Return the share of each of `ACTIONS` in (samples,); an attack counts whatever its target."""
    counts = np.bincount(actions, minlength=FIRST_ATTACK + 1)
    counts = np.append(counts[1:FIRST_ATTACK], counts[FIRST_ATTACK:].sum()) / max(len(actions), 1)
    return dict(zip(ACTIONS, np.round(counts, 3).tolist()))


def main() -> None:
    """Measure all skills of all seeds of the run and write the record."""
    args = run_and_out_parser(__doc__, "folder of a run on micro_battle").parse_args()
    about = describe_script(args.run)
    num_skills = run_folder.read_config(args.run).algorithm.num_skills
    rows = []
    for seed in run_folder.seeds_of(args.run):
        trained = load_run(args.run, seed)
        for skill in range(num_skills):
            row = {"seed": seed, "skill": skill, "env_steps": trained.env_steps}
            rows.append(row | measure_skill(trained, skill))
            print(rows[-1], flush=True)
    write_rows(args.out, about, rows)


if __name__ == "__main__":
    main()
