"""Measure what uniformly random legal actions earn per episode.

python scripts/random_play.py [TASK ...] [--out results/random_play.json]

Plays the named tasks, or all, and replaces their rows in the JSON file.
"""

import argparse
import json
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Key

import envs_jax
from hmasd_jax.runs import folder as run_folder
from scripts.records import RESULTS, describe_script

COPIES = 1000
"""Environment copies that are stepped together."""


class Task(NamedTuple):
    """An environment, and how many episodes of it to play."""

    episodes: int
    env: str
    options: dict[str, str]


TASKS = {"alice_and_bob": Task(1_000_000, "alice_and_bob", {})}
TASKS |= {
    f"{layout} {rule}": Task(400_000, "overcooked", {"layout": layout, "start_cooking": rule})
    for layout in ("cramped_room", "asymmetric_advantages", "coordination_ring")
    for rule in ("interact", "auto")
}
TASKS |= {
    f"{scenario} {balance}": Task(
        1_000_000, "micro_battle", {"scenario": scenario, "balance": balance}
    )
    for scenario, balance in (
        ("3m", "multi"),
        ("2s_vs_1sc", "multi"),
        ("2s_vs_1sc", "liberty"),
        ("2m_vs_1z", "multi"),
    )
}


class Tally(NamedTuple):
    """Totals of each copy's episode so far."""

    over: Bool[Array, " E"]
    returns: Float[Array, " E"]
    steps: Float[Array, " E"]
    late: Bool[Array, " E"]
    """True if the episode ended at its time limit."""


def make_play(env: envs_jax.Environment):
    """Return a compiled function that maps a key to the `Tally` of `COPIES` whole episodes."""

    def step(carry):
        env_state, mask, tally, key = carry
        key, key_action, key_step = jax.random.split(key, 3)
        action = envs_jax.random_actions(key_action, mask)
        keys = jax.random.split(key_step, COPIES)
        env_state, timestep = jax.vmap(env.step)(keys, env_state, action)
        tally = Tally(
            over=tally.over | timestep.done,
            returns=tally.returns + jnp.where(tally.over, 0, timestep.reward),
            steps=tally.steps + ~tally.over,
            late=tally.late | (timestep.truncated & ~tally.over),
        )
        return env_state, timestep.action_mask, tally, key

    @jax.jit
    def play(key: Key[Array, ""]) -> Tally:
        key_reset, key_play = jax.random.split(key)
        env_state, timestep = jax.vmap(env.reset)(jax.random.split(key_reset, COPIES))
        zero = jnp.zeros(COPIES)
        tally = Tally(over=timestep.done, returns=zero, steps=zero, late=timestep.done)
        start = (env_state, timestep.action_mask, tally, key_play)
        return jax.lax.while_loop(lambda carry: ~carry[2].over.all(), step, start)[2]

    return play


def measure(task: Task) -> dict[str, float]:
    """Play the episodes of one task and return their statistics."""
    play = make_play(envs_jax.make(task.env, **task.options))
    keys = jax.random.split(jax.random.key(0), task.episodes // COPIES)
    batches = [jax.device_get(play(key)) for key in keys]
    tally = Tally(*(np.concatenate(column).astype(float) for column in zip(*batches)))
    returns = np.asarray(tally.returns)
    return {
        "episodes": len(returns),
        "paid_episodes": int((returns > 0).sum()),
        "mean_return": float(returns.mean()),
        "standard_error": float(returns.std() / len(returns) ** 0.5),
        "out_of_time": int(tally.late.sum()),
        "env_steps": int(tally.steps.sum()),
    }


def main() -> None:
    """Play the tasks of the command line, and write each row as soon as it is there."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("tasks", nargs="*", metavar="TASK", help=f"any of: {', '.join(TASKS)}")
    parser.add_argument("--out", type=Path, default=RESULTS / "random_play.json")
    args = parser.parse_args()
    for name in args.tasks:
        if name not in TASKS:
            parser.error(f"unknown task {name!r}; choose from {', '.join(map(repr, TASKS))}")
    about = describe_script()
    for name in args.tasks or TASKS:
        command = [*about["command"][:2], name]  # plays this row alone
        row = about | {"command": command} | measure(TASKS[name])
        print(name, row, flush=True)
        rows = json.loads(args.out.read_text()) if args.out.exists() else {}
        run_folder.write_json(args.out, rows | {name: row})


if __name__ == "__main__":
    main()
