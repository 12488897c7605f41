"""How often uniformly random legal actions win: python results/micro_battle/random_play.py [N].

Plays N episodes (default 1,000,000) of each of the paper's scenarios and writes random.json beside
this file.
"""

import json
import sys
from pathlib import Path

import jax
import jax.numpy as jnp

from envs_jax.micro_battle import MicroBattle

COPIES = 1000
SCENARIOS = [
    ("3m", "multi"),
    ("2s_vs_1sc", "multi"),
    ("2s_vs_1sc", "liberty"),
    ("2m_vs_1z", "multi"),
]


def make_play(env: MicroBattle):
    """A compiled function of a key: wins, episodes out of time, and steps of `COPIES` episodes."""

    def step(carry):
        env_state, mask, over, won, late, steps, key = carry
        key, key_action, key_step = jax.random.split(key, 3)
        legal = jnp.cumsum(mask, -1)  # the n-th legal action, n uniform
        chance = jax.random.uniform(key_action, mask.shape[:-1])
        chosen = jnp.floor(chance * legal[..., -1])
        action = (legal <= chosen[..., None]).sum(-1)
        keys = jax.random.split(key_step, COPIES)
        env_state, timestep = jax.vmap(env.step)(keys, env_state, action)
        won += ((timestep.reward > 0) & ~over).sum()
        late += (timestep.truncated & ~over).sum()
        steps += (~over).sum()
        return env_state, timestep.action_mask, over | timestep.done, won, late, steps, key

    @jax.jit
    def play(key):
        key_reset, key_play = jax.random.split(key)
        env_state, timestep = jax.vmap(env.reset)(jax.random.split(key_reset, COPIES))
        zero = jnp.int32(0)
        carry = (env_state, timestep.action_mask, timestep.done, zero, zero, zero, key_play)
        return jax.lax.while_loop(lambda carry: ~carry[2].all(), step, carry)[3:6]

    return play


def main() -> None:
    """Count, print and write."""
    episodes = int(sys.argv[1]) if len(sys.argv) > 1 else 1_000_000
    rows = []
    for scenario, balance in SCENARIOS:
        play = make_play(MicroBattle(scenario, balance))
        counts = [0, 0, 0]
        for batch in range(episodes // COPIES):
            new = play(jax.random.fold_in(jax.random.key(0), batch))
            counts = [int(a) + b for a, b in zip(new, counts)]
        names = ("wins", "out_of_time", "env_steps")
        rows.append({"scenario": scenario, "balance": balance, "episodes": episodes})
        rows[-1] |= dict(zip(names, counts))
        print(rows[-1], flush=True)
    record = {"command": "python results/micro_battle/random_play.py", "rows": rows}
    path = Path(__file__).with_name("random.json")
    path.write_text(json.dumps(record, indent=2) + "\n")


if __name__ == "__main__":
    main()
