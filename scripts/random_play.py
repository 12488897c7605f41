"""What uniformly random legal actions earn, per episode.

python results/random_play.py [TASK ...]

Plays the tasks named, or all, and writes what came of them into random_play.json beside this file.
"""

import json
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import envs_jax
from hmasd_jax.runs import folder as run_folder

COPIES = 1000
TASKS = {
    f"{layout} {rule}": (
        400_000,
        "overcooked",
        {"layout": layout, "start_cooking": rule},
    )
    for layout in ("cramped_room", "asymmetric_advantages", "coordination_ring")
    for rule in ("interact", "auto")
} | {
    f"{scenario} {balance}": (
        1_000_000,
        "micro_battle",
        {"scenario": scenario, "balance": balance},
    )
    for scenario, balance in (
        ("3m", "multi"),
        ("2s_vs_1sc", "multi"),
        ("2s_vs_1sc", "liberty"),
        ("2m_vs_1z", "multi"),
    )
}
"""Episodes, environment and its options, under a name."""


def make_play(env: envs_jax.Environment):
    """A compiled function of a key: return, steps and lateness of `COPIES` episodes."""

    def step(carry):
        env_state, mask, over, returns, steps, late, key = carry
        key, key_action, key_step = jax.random.split(key, 3)
        action = envs_jax.random_actions(key_action, mask)
        env_state, timestep = jax.vmap(env.step)(
            jax.random.split(key_step, COPIES), env_state, action
        )
        returns += jnp.where(over, 0, timestep.reward)
        late |= timestep.truncated & ~over
        return (
            env_state,
            timestep.action_mask,
            over | timestep.done,
            returns,
            steps + ~over,
            late,
            key,
        )

    @jax.jit
    def play(key):
        key_reset, key_play = jax.random.split(key)
        env_state, timestep = jax.vmap(env.reset)(jax.random.split(key_reset, COPIES))
        over = timestep.done
        zero = jnp.zeros(COPIES)
        carry = (env_state, timestep.action_mask, over, zero, zero, over, key_play)
        return jax.lax.while_loop(lambda carry: ~carry[2].all(), step, carry)[3:6]

    return play


def measure(episodes: int, name: str, options: dict[str, str]) -> dict[str, float]:
    """The row of one task."""
    play = make_play(envs_jax.make(name, **options))
    keys = jax.random.split(jax.random.key(0), episodes // COPIES)
    batches = [jax.device_get(play(key)) for key in keys]
    returns, steps, late = (np.concatenate(column).astype(float) for column in zip(*batches))
    return {
        "episodes": len(returns),
        "paid_episodes": int((returns > 0).sum()),
        "mean_return": float(returns.mean()),
        "standard_error": float(returns.std() / len(returns) ** 0.5),
        "out_of_time": int(late.sum()),
        "env_steps": int(steps.sum()),
    }


def main() -> None:
    """Play, print and write."""
    path = Path(__file__).with_name("random_play.json")
    for task in sys.argv[1:] or TASKS:
        about = run_folder.describe(["python", "results/random_play.py", task])
        row = about | measure(*TASKS[task])
        print(task, row, flush=True)
        rows = json.loads(path.read_text()) if path.exists() else {}
        path.write_text(json.dumps(rows | {task: row}, indent=2) + "\n")


if __name__ == "__main__":
    main()
