"""How often uniformly random legal actions win.

python results/micro_battle/random_play.py [EPISODES [SCENARIO BALANCE]]

Plays so many episodes (default 1,000,000) of each of the paper's scenarios, or of one, and writes
down the counts in random.json beside this file.
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
    episodes, *chosen = sys.argv[1:] or ["1000000"]
    path = Path(__file__).with_name("random.json")
    for scenario, balance in [tuple(chosen)] if chosen else SCENARIOS:
        play = make_play(MicroBattle(scenario, balance))
        counts = [0, 0, 0]
        for batch in range(int(episodes) // COPIES):
            new = play(jax.random.fold_in(jax.random.key(0), batch))
            counts = [int(a) + b for a, b in zip(new, counts)]
        command = f"python results/micro_battle/random_play.py {episodes} {scenario} {balance}"
        row = {"command": command, "episodes": int(episodes)}
        row |= dict(zip(("wins", "out_of_time", "env_steps"), counts))
        print(row, flush=True)
        rows = json.loads(path.read_text()) if path.exists() else {}
        rows[f"{scenario} {balance}"] = row
        path.write_text(json.dumps(rows, indent=2) + "\n")


if __name__ == "__main__":
    main()
