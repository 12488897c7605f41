"""Networks of MAPPO against NumPy written to PyTorch's conventions."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

from hmasd_jax.networks.gru import GRU, gru_cell
from hmasd_jax.networks.layer_norm import LayerNorm, NormedDense, standardize
from hmasd_jax.networks.recurrent import MLP, RecurrentNet, dense
from hmasd_jax.rl.categorical import mask_logits

TIME, BATCH, INPUTS, SIZE = 5, 3, 4, 8


def randomize(params, scale=0.5):
    """The same tree with noise added, so that no bias or LayerNorm is at its neutral value."""
    rng = np.random.default_rng(7)
    return jax.tree.map(
        lambda p: np.asarray(p) + scale * rng.normal(size=p.shape).astype(np.float32), params
    )


def init(module, *args):
    """Parameters as NumPy arrays; compiled as one piece, which is faster than op by op."""
    return jax.tree.map(np.asarray, jax.jit(module.init)(jax.random.key(0), *args))


def apply(module, params, *args):
    """Outputs as NumPy arrays."""
    return jax.tree.map(np.asarray, jax.jit(module.apply)(params, *args))


def numpy_layer_norm(x, params):
    deviation = x - x.mean(-1, keepdims=True)
    variance = (deviation**2).mean(-1, keepdims=True)  # population
    return deviation / np.sqrt(variance + 1e-5) * params["scale"] + params["bias"]


def numpy_linear(x, params):
    return x @ params["kernel"] + params.get("bias", 0.0)


def numpy_mlp(x, params):
    for i in range(2):
        x = numpy_layer_norm(x, params[f"LayerNorm_{i}"])
        x = np.maximum(numpy_linear(x, params[f"Dense_{i}"]), 0.0)
    return x


def numpy_gru(h, x, first, params):
    """`torch.nn.GRU`, gates in the order r, z, n, with the memory zeroed where `first`."""
    sigmoid = lambda a: 1 / (1 + np.exp(-a))  # noqa: E731
    outputs = []
    for x_t, first_t in zip(x, first):
        h = np.where(first_t[..., None], 0.0, h)
        i_r, i_z, i_n = np.split(numpy_linear(x_t, params["input"]), 3, -1)
        h_r, h_z, h_n = np.split(h @ params["kernel"] + params["bias"], 3, -1)
        r, z = sigmoid(i_r + h_r), sigmoid(i_z + h_z)
        n = np.tanh(i_n + r * h_n)
        h = (1 - z) * n + z * h
        outputs.append(h)
    return h, np.stack(outputs)


def _sequence(size=SIZE):
    rng = np.random.default_rng(0)
    memory = rng.normal(size=(BATCH, SIZE)).astype(np.float32)
    x = rng.normal(size=(TIME, BATCH, size)).astype(np.float32)
    first = np.zeros((TIME, BATCH), bool)
    first[0, 0] = first[2, 1] = first[4, 1] = True
    return memory, x, first


def test_layer_norm_has_pytorchs_epsilon():
    # x = (0, 0.002): deviations -+1e-3, variance 1e-6; 1e-3 / sqrt(1e-6 + 1e-5) = 0.301511.
    # With flax's default epsilon 1e-6 it would be 0.707.
    norm = LayerNorm()
    x = jnp.array([0.0, 0.002])
    result = apply(norm, init(norm, x), x)
    assert_allclose(result, [-0.301511, 0.301511], rtol=1e-4)


def test_layer_norm_survives_a_large_offset():
    # One-pass variance E[x^2] - E[x]^2 would lose all digits of a variance of 1 at 1e4.
    norm = LayerNorm()
    x = jnp.array([1e4 - 1, 1e4 + 1])
    assert_allclose(apply(norm, init(norm, x), x), [-1.0, 1.0], rtol=1e-4)


@pytest.mark.parametrize("gain", [0.01, 1.0, np.sqrt(2)])
@pytest.mark.parametrize("shape", [(12, 5), (5, 12)])
def test_linear_weights_are_orthogonal_with_the_gain_and_biases_zero(gain, shape):
    layer = dense(shape[1], gain)
    params = init(layer, jnp.zeros(shape[0]))["params"]
    singular_values = np.linalg.svd(params["kernel"], compute_uv=False)
    assert_allclose(singular_values, np.full(5, gain), rtol=1e-4)
    np.testing.assert_array_equal(params["bias"], 0.0)


def test_mlp_is_two_blocks_of_layer_norm_linear_relu():
    _, x, _ = _sequence(INPUTS)
    mlp = MLP(SIZE)
    params = randomize(init(mlp, x))
    assert_allclose(apply(mlp, params, x), numpy_mlp(x, params["params"]), atol=1e-5)


def test_gru_matches_pytorchs_and_forgets_where_an_episode_begins():
    memory, x, first = _sequence()
    gru = GRU(SIZE, LayerNorm())
    params = randomize(init(gru, memory, x, first))
    last, outputs = apply(gru, params, memory, x, first)
    normed = numpy_layer_norm(x, params["params"]["norm"])
    expected_last, expected = numpy_gru(memory, normed, first, params["params"])
    assert_allclose(outputs, expected, atol=1e-5)
    assert_allclose(last, expected_last, atol=1e-5)


def test_the_written_gradient_of_the_gru_cell_is_that_of_its_formula():
    def formula(h, from_input, from_memory):
        (i_r, i_z, i_n), (h_r, h_z, h_n) = jnp.split(from_input, 3), jnp.split(from_memory, 3)
        r, z = jax.nn.sigmoid(i_r + h_r), jax.nn.sigmoid(i_z + h_z)
        return (1 - z) * jnp.tanh(i_n + r * h_n) + z * h

    rng = np.random.default_rng(3)
    inputs = [rng.normal(size=n).astype(np.float32) for n in (SIZE, 3 * SIZE, 3 * SIZE)]
    for ours, expected in zip(*(jax.jacrev(f, (0, 1, 2))(*inputs) for f in (gru_cell, formula))):
        assert abs(expected).max() > 0.1
        assert_allclose(ours, expected, atol=1e-6)


def test_the_written_gradient_of_standardize_is_that_of_its_formula():
    def formula(x):
        deviation = x - x.mean(-1, keepdims=True)
        return deviation / jnp.sqrt((deviation**2).mean(-1, keepdims=True) + 1e-5)

    x = np.random.default_rng(4).normal(size=(2, SIZE)).astype(np.float32)
    expected = jax.jacrev(formula)(x)
    assert abs(expected).max() > 0.1
    assert_allclose(jax.jacrev(standardize)(x), expected, atol=1e-5)


def test_a_linear_layer_with_a_folded_layer_norm_learns_like_the_two_layers_apart():
    rng = np.random.default_rng(5)
    x, more = rng.normal(size=(BATCH, SIZE)), rng.normal(size=(BATCH, 2))
    layer = NormedDense(INPUTS, 1.0, LayerNorm())
    params = randomize(init(layer, x, more))

    def loss(params):
        return (layer.apply(params, x, more) ** 2).sum()

    def loss_apart(params):
        normed = LayerNorm().apply({"params": params["params"]["norm"]}, x)
        inputs = jnp.concatenate([normed, more], axis=-1)
        return (numpy_linear(inputs, params["params"]) ** 2).sum()

    both = (jax.value_and_grad(f)(params) for f in (loss, loss_apart))
    jax.tree.map(
        lambda ours, expected: assert_allclose(ours, expected, rtol=1e-3, atol=1e-4), *both
    )


def test_what_came_before_first_has_no_effect_and_what_came_before_others_has():
    memory, x, first = _sequence()
    gru = GRU(SIZE, LayerNorm())
    params = init(gru, memory, x, first)
    _, outputs = apply(gru, params, memory, x, first)
    _, changed = apply(gru, params, memory + 1.0, x, first)
    # Row 0 resets at step 0, row 1 at step 2, row 2 never.
    np.testing.assert_array_equal(changed[:, 0], outputs[:, 0])
    np.testing.assert_array_equal(changed[2:, 1], outputs[2:, 1])
    assert (abs(changed - outputs)[:2, 1].max(-1) > 1e-3).all()
    assert (abs(changed - outputs)[:, 2].max(-1) > 1e-4).all()


def test_gru_in_two_halves_is_gru_in_one():
    memory, x, first = _sequence()
    gru = GRU(SIZE, LayerNorm())
    params = init(gru, memory, x, first)
    last, outputs = apply(gru, params, memory, x, first)
    middle, head = apply(gru, params, memory, x[:2], first[:2])
    end, tail = apply(gru, params, middle, x[2:], first[2:])
    assert_allclose(np.concatenate([head, tail]), outputs, atol=1e-6)
    assert_allclose(end, last, atol=1e-6)


def test_gru_weights_are_orthogonal_as_one_stacked_matrix():
    memory, x, first = _sequence()
    params = init(GRU(SIZE, LayerNorm()), memory, x, first)["params"]
    for kernel in (params["kernel"], params["input"]["kernel"]):
        assert kernel.shape == (SIZE, 3 * SIZE)
        assert_allclose(kernel @ kernel.T, np.eye(SIZE), atol=1e-5)
        # Gate by gate, each third would be orthogonal by itself (and the whole have norm 3).
        gate = kernel[:, :SIZE]
        assert abs(gate @ gate.T - np.eye(SIZE)).max() > 0.1
    np.testing.assert_array_equal(params["bias"], 0.0)
    np.testing.assert_array_equal(params["input"]["bias"], 0.0)


def _net(skill_at, gain=1.0, num_outputs=3):
    memory, x, first = _sequence(INPUTS)
    net = RecurrentNet(num_outputs, SIZE, gain, num_skills=2, skill_at=skill_at)
    return net, init(net, memory, x, first, np.zeros((TIME, BATCH), int)), (memory, x, first)


def test_a_skill_needs_a_number_of_skills():
    memory, x, first = _sequence(INPUTS)
    skill = np.zeros((TIME, BATCH), int)
    with pytest.raises(ValueError, match="num_skills must be above 0 with a skill, got 0"):
        init(RecurrentNet(3, SIZE, 1.0), memory, x, first, skill)


def test_recurrent_net_is_mlp_gru_norm_head_and_carries_the_memory_unnormalized():
    net, params, (memory, x, first) = _net("last_layer")
    params = randomize(params)
    skill = np.arange(TIME * BATCH).reshape(TIME, BATCH) % 2
    last, outputs = apply(net, params, memory, x, first, skill)
    p = params["params"]
    features = numpy_layer_norm(numpy_mlp(x, p["MLP_0"]), p["MLP_0"]["LayerNorm_2"])
    expected_last, features = numpy_gru(memory, features, first, p["GRU_0"])
    features = numpy_layer_norm(features, p["LayerNorm_0"])
    features = np.concatenate([features, np.eye(2)[skill]], -1)
    assert_allclose(outputs, numpy_linear(features, p["head"]), atol=1e-4)
    assert_allclose(last, expected_last, atol=1e-5)


def test_at_the_input_the_skill_joins_before_the_first_layer_norm():
    net, params, (memory, x, first) = _net("input")
    params = randomize(params)
    skill = np.arange(TIME * BATCH).reshape(TIME, BATCH) % 2
    _, outputs = apply(net, params, memory, x, first, skill)
    p = params["params"]
    inputs = np.concatenate([x, np.eye(2)[skill]], -1)
    features = numpy_layer_norm(numpy_mlp(inputs, p["MLP_0"]), p["MLP_0"]["LayerNorm_2"])
    _, features = numpy_gru(memory, features, first, p["GRU_0"])
    expected = numpy_linear(numpy_layer_norm(features, p["LayerNorm_0"]), p["head"])
    assert_allclose(outputs, expected, atol=1e-4)


@pytest.mark.parametrize(("skill_at", "is_offset"), [("last_layer", True), ("input", False)])
def test_a_skill_is_a_constant_offset_only_at_the_last_layer(skill_at, is_offset):
    net, params, (memory, x, first) = _net(skill_at)
    # Both skills side by side on the batch axis.
    skill = np.repeat([0, 1], BATCH)[None].repeat(TIME, 0)
    x, first = np.concatenate([x, x], 1), np.concatenate([first, first], 1)
    _, outputs = apply(net, params, np.concatenate([memory, memory]), x, first, skill)
    difference = (outputs[:, BATCH:] - outputs[:, :BATCH]).reshape(-1, 3)
    assert abs(difference).max() > 1e-2
    spread = (difference.max(0) - difference.min(0)).max()
    assert spread < 1e-5 if is_offset else spread > 1e-2


@pytest.mark.parametrize("gain", [0.01, 1.0])
def test_the_head_has_its_own_gain(gain):
    _, params, _ = _net("last_layer", gain)
    head = params["params"]["head"]
    assert head["kernel"].shape == (SIZE + 2, 3)
    assert_allclose(np.linalg.svd(head["kernel"], compute_uv=False), np.full(3, gain), rtol=1e-4)


def test_a_masked_logit_has_probability_zero_and_no_gradient():
    mask = jnp.array([True, False, True])

    def log_prob(logits):
        return jax.nn.log_softmax(mask_logits(logits, mask))

    logits = jnp.array([1.0, 5.0, 1.0])
    assert_allclose(jnp.exp(log_prob(logits)), [0.5, 0.0, 0.5])
    # d log p_0 / d logits = (1 - 0.5, 0, -0.5)
    assert_allclose(jax.grad(lambda x: log_prob(x)[0])(logits), [0.5, 0.0, -0.5])
