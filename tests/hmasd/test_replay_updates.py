"""The script that replays updates step by step."""

from dataclasses import replace

import chex
import jax

from hmasd_jax.hmasd import algorithm as hmasd
from hmasd_jax.hmasd.batches import high_batch
from hmasd_jax.hmasd.rollout_phase import collect
from scripts.replay_updates import coordinator_steps


def test_the_steps_of_a_replay_are_those_of_the_update(parts, trained, algorithm):
    learner, metrics = jax.jit(lambda state: coordinator_steps(parts, state))(trained)
    after, means = algorithm.update(trained)
    chex.assert_trees_all_close(learner.params, after.coordinator.params, rtol=1e-4, atol=1e-5)
    mean = {f"coordinator/{name}": values.mean() for name, values in metrics.items()}
    chex.assert_trees_all_close(mean, {name: means[name] for name in mean}, rtol=1e-3, atol=1e-6)


def test_minibatches_of_a_replay_are_those_of_the_update(parts, trained):
    ppo = replace(parts.config.ppo, num_epochs=2, num_minibatches=2)
    parts = replace(parts, config=replace(parts.config, ppo=ppo))

    @jax.jit
    def train_both(state):
        _, key_collect, key_choose, key_high, *_ = jax.random.split(state.key, 6)
        params = state.coordinator.params, state.discoverer.params
        rollout = collect(parts, *params, state.env, state.memory, key_collect)
        batch = high_batch(parts, params[0], state.coordinator_norm, rollout, key_choose)
        trained, *_ = hmasd.train_coordinator(parts, state, batch, key_high)
        return coordinator_steps(parts, state)[0].params, trained.params

    replayed, trained_params = train_both(trained)
    chex.assert_trees_all_close(replayed, trained_params, rtol=1e-4, atol=1e-5)
