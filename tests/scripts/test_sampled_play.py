"""The script that compares greedy and sampled play."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp

import envs_jax
from hmasd_jax.types import Policy
from scripts.sampled_play import compare_play

ENV = envs_jax.make("probe_match_cue")


def test_both_kinds_of_play_are_measured_and_named():
    def policy(state, greedy):
        # Action 1 where sampled, and the action of the cue where greedy.
        def step(memory, timestep, first, key):
            cue = timestep.obs[..., 1] > timestep.obs[..., 0]
            action = jnp.where(greedy, cue, ~cue).astype(int)
            return memory, action, ()

        return Policy(lambda batch_shape: jnp.zeros(batch_shape), step)

    algorithm = SimpleNamespace(policy=policy)
    means = compare_play(ENV, algorithm, None, jax.random.key(0), 8)
    assert set(means) == {"greedy", "sampled"}
    assert means["greedy"]["return"] > means["sampled"]["return"]
