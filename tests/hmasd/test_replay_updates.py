"""The script that replays updates step by step."""

import chex
import jax

from scripts.replay_updates import coordinator_steps


def test_the_steps_of_a_replay_are_those_of_the_update(parts, trained, algorithm):
    learner, metrics = jax.jit(lambda state: coordinator_steps(parts, state))(trained)
    after, means = algorithm.update(trained)
    chex.assert_trees_all_close(learner.params, after.coordinator.params, rtol=1e-4, atol=1e-5)
    mean = {f"coordinator/{name}": values.mean() for name, values in metrics.items()}
    chex.assert_trees_all_close(mean, {name: means[name] for name in mean}, rtol=1e-3, atol=1e-6)
