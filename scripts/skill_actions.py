"""What the individual skills of a trained run do in a battle.

python results/micro_battle/skill_actions.py RUN OUT

Every skill is given to all agents under team skill 0, and actions are sampled. OUT (JSON) gets, for
each seed and skill, how often living agents take each action where they can attack and where they
cannot, and what comes of the battles.
"""

import json
import sys
from pathlib import Path

import jax
import numpy as np

from envs_jax.micro_battle.observations import FIRST_ATTACK
from hmasd_jax.rl import rollout
from hmasd_jax.runs import folder as run_folder
from hmasd_jax.runs.load import load_run

COPIES = 200
ACTIONS = ("stop", "north", "south", "east", "west")


def look(run: Path, seed: int, skill: int) -> dict:
    """What agents with `skill` do in `COPIES` battles that are begun anew until the time is up."""
    trained = load_run(run, seed)
    env = trained.env
    skills = (0,) + (skill,) * env.num_agents
    policy = trained.algorithm.policy(trained.state, False, skills=skills)

    @jax.jit
    def play(key):
        carry = rollout.reset(env, key, COPIES)
        memory = policy.init((COPIES,))
        return rollout.unroll(env, policy.step, carry, memory, key, env.max_steps)[2]

    played = jax.device_get(play(jax.random.key(1)))
    mask, action = played.timestep.action_mask, played.action
    alive, armed = ~mask[..., 0], mask[..., FIRST_ATTACK:].any(-1)
    over = played.outcome.done
    return {
        "seed": seed,
        "skill": skill,
        "env_steps": trained.env_steps,
        "episodes": int(over.sum()),
        "wins": float(played.outcome.reward.sum() / over.sum()),
        "enemies_killed": float(
            len(env.layout.enemies) - played.outcome.info["enemies_alive"][over].mean()
        ),
        "episode_length": float(over.size / over.sum()),
        "share_in_range": float((armed & alive).sum() / alive.sum()),
        "out_of_range": _shares(action[alive & ~armed]),
        "in_range": _shares(action[alive & armed]),
    }


def _shares(actions: np.ndarray) -> dict[str, float]:
    """Of each kind of action; attacks on any enemy together."""
    counts = np.bincount(actions, minlength=FIRST_ATTACK + 1)
    counts = np.append(counts[1:FIRST_ATTACK], counts[FIRST_ATTACK:].sum()) / max(len(actions), 1)
    return dict(zip((*ACTIONS, "attack"), np.round(counts, 3).tolist()))


def main() -> None:
    """Look at all skills of all seeds and write."""
    run, out = map(Path, sys.argv[1:])
    num_skills = run_folder.read_config(run).algorithm.num_skills
    rows = [look(run, seed, z) for seed in run_folder.seeds_of(run) for z in range(num_skills)]
    about = run_folder.describe(["python", *sys.argv])
    about["run"] = json.loads((run / "run.json").read_text())
    out.write_text(json.dumps(about | {"rows": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
