"""Gradient clipping, Adam and epochs of minibatches, by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import optax
from numpy.testing import assert_allclose

from hmasd_jax.rl.averaging import averaged_params
from hmasd_jax.rl.ppo import PPOConfig
from hmasd_jax.rl.sgd import gradient_step, make_optimizer, scale_steps, sgd_epochs
from hmasd_jax.types import Learner


def _linear_loss(params, gradient):
    """A loss whose gradient is `gradient`."""
    products = jax.tree.map(lambda p, g: (p * g).sum(), params, gradient)
    return sum(jax.tree.leaves(products)), {}


def _first_moment(learner, network):
    """Adam's, of all parameters of a network in one vector, in order of their names."""
    (moment,) = (
        s.mu
        for s in jax.tree.leaves(
            learner.opt_state.inner_states[network],
            is_leaf=lambda s: isinstance(s, optax.ScaleByAdamState),
        )
        if isinstance(s, optax.ScaleByAdamState)
    )
    return moment


def _step(gradient, config):
    params = jax.tree.map(jnp.zeros_like, gradient)
    optimizer = make_optimizer(config, list(params))
    learner = Learner(params, optimizer.init(params))
    return gradient_step(learner, optimizer, _linear_loss, gradient)


def test_a_long_gradient_comes_out_with_norm_max_grad_norm_direction_kept():
    # Norm of (30, 40, 0; 0, 0, 120) is 130; clipped at 10 it is scaled by 1/13. After one step
    # Adam's first moment is 0.1 times the gradient that reached it.
    gradient = {"net": {"w": jnp.array([30.0, 40.0, 0.0]), "b": jnp.array([0.0, 0.0, 120.0])}}
    learner, metrics = _step(gradient, PPOConfig(max_grad_norm=10.0))
    moment = _first_moment(learner, "net")
    assert_allclose(np.linalg.norm(moment), 0.1 * 10.0, rtol=1e-5)
    assert_allclose(moment, 0.1 * np.array([0, 0, 120, 30, 40, 0]) / 13, rtol=1e-5)
    assert_allclose(metrics["grad_norm"], 130.0, rtol=1e-6)


def test_each_network_is_clipped_by_its_own_norm():
    # Actor's norm 50 is clipped to 10. The critic's norm 9 is left alone, although the joint norm
    # is above 10; so is the joint norm after clipping, sqrt(100 + 81).
    gradient = {"actor": jnp.array([30.0, 40.0]), "critic": jnp.array([9.0])}
    learner, _ = _step(gradient, PPOConfig(max_grad_norm=10.0))
    assert_allclose(_first_moment(learner, "actor"), [0.6, 0.8], rtol=1e-5)
    assert_allclose(_first_moment(learner, "critic"), [0.9], rtol=1e-5)


def test_adam_steps_by_hand():
    # Adam(lr 0.1, b1 0.9, b2 0.999, eps 1e-5), gradients 2 then -1, bias-corrected:
    #   step 1: m = 2, v = 4                          x -= 0.1 * 2 / (2 + 1e-5)
    #   step 2: m = (0.9 * 0.2 - 0.1) / 0.19          = 0.08 / 0.19
    #           v = (0.999 * 0.004 + 0.001) / 0.001999 = 0.004996 / 0.001999
    config = PPOConfig(learning_rate=0.1, adam_epsilon=1e-5)
    optimizer = make_optimizer(config, ["net"])
    params = {"net": jnp.zeros(1)}
    learner = Learner(params, optimizer.init(params))
    expected = 0.0
    for gradient, m, v in [(2.0, 2.0, 4.0), (-1.0, 0.08 / 0.19, 0.004996 / 0.001999)]:
        learner, _ = gradient_step(learner, optimizer, _linear_loss, {"net": jnp.array([gradient])})
        expected -= 0.1 * m / (np.sqrt(v) + 1e-5)
        assert_allclose(learner.params["net"], [expected], rtol=1e-5)


def test_adam_epsilon_is_added_outside_the_root():
    # A gradient of 1e-5 at the first step: 1e-5 / (1e-5 + 1e-5) = 1/2 of the learning rate.
    # Inside the root it would be 1e-5 / sqrt(1e-10 + 1e-5) = 0.003.
    learner, _ = _step({"net": jnp.array([1e-5])}, PPOConfig(learning_rate=0.1))
    assert_allclose(learner.params["net"], [-0.05], rtol=1e-4)


def test_the_step_size_can_fall_linearly_to_zero():
    # 2 updates of 2 epochs: 4 steps. Under a constant gradient Adam moves by the step size:
    # 0.1, 0.075, 0.05, 0.025, and then not at all.
    config = PPOConfig(learning_rate=0.1, decay_updates=2, num_epochs=2)
    params, gradient = {"net": jnp.zeros(1)}, {"net": jnp.ones(1)}
    for steps_per_update, expected in [
        (None, [-0.1, -0.175, -0.225, -0.25, -0.25]),
        (1, [-0.1, -0.15, -0.15, -0.15, -0.15]),  # given: 2 updates of 1 step
    ]:
        optimizer = make_optimizer(config, ["net"], steps_per_update)
        learner, path = Learner(params, optimizer.init(params)), []
        for _ in range(5):
            learner, _ = gradient_step(learner, optimizer, _linear_loss, gradient)
            path.append(float(learner.params["net"][0]))
        assert_allclose(path, expected, rtol=1e-4)


def test_shorter_steps_leave_adam_as_it_is_and_the_average_follows_them():
    config = PPOConfig(learning_rate=0.1, average_updates=1, num_epochs=2)
    params, gradient = {"net": jnp.zeros(2)}, {"net": jnp.array([3.0, -1.0])}
    optimizer = make_optimizer(config, ["net"])
    full, short = [
        gradient_step(Learner(params, steps.init(params)), steps, _linear_loss, gradient)[0]
        for steps in (optimizer, scale_steps(optimizer, jnp.float32(0.25)))
    ]
    assert_allclose(full.params["net"], [-0.1, 0.1], rtol=1e-4)
    assert_allclose(short.params["net"], [-0.025, 0.025], rtol=1e-4)
    assert_allclose(averaged_params(short)["net"], [-0.025, 0.025], rtol=1e-4)
    np.testing.assert_array_equal(_first_moment(short, "net"), _first_moment(full, "net"))


def _count_samples(num_epochs, num_minibatches, key=0):
    """Count for each step how often it saw each sample."""

    def step(carry, minibatch):
        position, seen = carry
        seen = seen.at[position].set(jnp.zeros(8).at[minibatch["index"]].add(1.0))
        mean = minibatch["index"].astype(jnp.float32).mean()
        return (position + 1, seen), {"mean": mean, "position": position.astype(jnp.float32)}

    batch = {"index": jnp.arange(8), "twice": 2 * jnp.arange(8)}
    carry = (jnp.int32(0), jnp.zeros((num_epochs * num_minibatches, 8)))
    (_, seen), metrics = sgd_epochs(
        step, carry, batch, jax.random.key(key), num_epochs, num_minibatches
    )
    return np.asarray(seen).reshape(num_epochs, num_minibatches, 8), metrics


def test_every_epoch_sees_every_sample_once_in_minibatches_shuffled_anew():
    seen, metrics = _count_samples(num_epochs=3, num_minibatches=4)
    np.testing.assert_array_equal(seen.sum(1), 1.0)
    np.testing.assert_array_equal(seen.sum(2), 2.0)
    assert (seen[0] != seen[1]).any()
    assert (seen[1] != seen[2]).any()
    # Metrics are averaged over all 12 steps: mean index 3.5, mean position 5.5.
    assert_allclose([metrics["mean"], metrics["position"]], [3.5, 5.5])


def test_one_minibatch_is_the_whole_batch():
    seen, metrics = _count_samples(num_epochs=2, num_minibatches=1)
    np.testing.assert_array_equal(seen, 1.0)
    assert_allclose(metrics["position"], 0.5)


def test_samples_keep_their_parts_together():
    def step(carry, minibatch):
        return carry + abs(minibatch["twice"] - 2 * minibatch["index"]).sum(), {}

    batch = {"index": jnp.arange(8), "twice": 2 * jnp.arange(8)}
    mismatch, _ = sgd_epochs(step, jnp.int32(0), batch, jax.random.key(0), 2, 4)
    assert mismatch == 0


def test_the_key_decides_the_order():
    same, other = _count_samples(2, 4, key=0)[0], _count_samples(2, 4, key=1)[0]
    np.testing.assert_array_equal(same, _count_samples(2, 4, key=0)[0])
    assert (same != other).any()
