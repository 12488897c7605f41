"""MAT's blocks against NumPy, and what each token may see."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

from hmasd_jax.networks.transformer import (
    Attention,
    DecoderBlock,
    EncoderBlock,
    FeedForward,
    Head,
    gelu,
)

TOKENS, SIZE = 4, 8


def _tokens(seed=0):
    return np.random.default_rng(seed).normal(size=(TOKENS, SIZE)).astype(np.float32)


def _init(module, *args):
    return jax.tree.map(np.asarray, jax.jit(module.init)(jax.random.key(0), *args))


def _random_params(module, *args):
    """Initial parameters plus noise, so that no bias or LayerNorm is at its neutral value."""
    rng = np.random.default_rng(7)
    return jax.tree.map(
        lambda p: p + 0.5 * rng.normal(size=p.shape).astype(np.float32), _init(module, *args)
    )


def _apply(module, params, *args):
    return np.asarray(jax.jit(module.apply)(params, *args))


def _linear(x, p):
    return x @ p["kernel"] + p["bias"]


def _norm(x, p):
    x = x - x.mean(-1, keepdims=True)
    return x / np.sqrt((x**2).mean(-1, keepdims=True) + 1e-5) * p["scale"] + p["bias"]


def _gelu(x):
    return x * 0.5 * (1 + np.vectorize(math.erf)(np.asarray(x) / math.sqrt(2)))


def _attention(query, key, p, causal, heads=1):
    q, k, v = (_linear(x, p[n]) for x, n in ((query, "query"), (key, "key"), (key, "value")))
    outputs = []
    for q_h, k_h, v_h in zip(*(np.split(np.asarray(x), heads, -1) for x in (q, k, v))):
        scores = q_h @ k_h.T / np.sqrt(SIZE / heads)
        if causal:
            scores[np.triu_indices(TOKENS, 1)] = -np.inf
        weights = np.exp(scores - scores.max(-1, keepdims=True))
        outputs.append(weights / weights.sum(-1, keepdims=True) @ v_h)
    return _linear(np.concatenate(outputs, -1), p["output"])


def _feed_forward(x, p):
    # The code builds the outer layer first, so the first layer of the data's path is Dense_1.
    return _linear(_gelu(_linear(x, p["Dense_1"])), p["Dense_0"])


def test_gelu_is_the_exact_form():
    # x Phi(x) at 1 is 0.8413447; the tanh approximation gives 0.8411920.
    assert_allclose(gelu(jnp.array([1.0, -2.0])), [0.8413447, -0.0455003], rtol=2e-6)


@pytest.mark.parametrize("heads", [1, 2])
@pytest.mark.parametrize("causal", [False, True])
def test_attention(heads, causal):
    block = Attention(SIZE, heads, causal)
    query, key = _tokens(0), _tokens(1)
    params = _random_params(block, query, key)
    expected = _attention(query, key, params["params"], causal, heads)
    assert_allclose(_apply(block, params, query, key), expected, atol=1e-4)


def test_encoder_block_is_post_norm():
    block, x = EncoderBlock(SIZE, 1), _tokens()
    params = _random_params(block, x)
    p = params["params"]
    y = _norm(x + _attention(x, x, p["Attention_0"], causal=False), p["LayerNorm_0"])
    y = _norm(y + _feed_forward(y, p["FeedForward_0"]), p["LayerNorm_1"])
    assert_allclose(_apply(block, params, x), y, atol=1e-4)


def test_decoder_block_continues_from_the_encoders_tokens():
    block, x, e = DecoderBlock(SIZE, 1), _tokens(0), _tokens(1)
    params = _random_params(block, x, e)
    p = params["params"]
    y = _norm(x + _attention(x, x, p["Attention_0"], causal=True), p["LayerNorm_0"])
    # The query and the residual are the encoder's tokens, keys and values the decoder's.
    y = _norm(e + _attention(e, y, p["Attention_1"], causal=True), p["LayerNorm_1"])
    y = _norm(y + _feed_forward(y, p["FeedForward_0"]), p["LayerNorm_2"])
    assert_allclose(_apply(block, params, x, e), y, atol=1e-4)


def _variants(x):
    """`x` itself, then `x` with each one of its tokens replaced."""
    return np.stack(
        [x, *(np.where(np.eye(TOKENS)[i, :, None], _tokens(2), x) for i in range(TOKENS))]
    )


def _dependence(outputs):
    """[i, j]: whether output j changed when token i was replaced."""
    return abs(outputs[1:] - outputs[0]).max(-1) > 1e-5


def test_decoder_outputs_depend_on_earlier_inputs_and_their_own_encoding_only():
    block, x, e = DecoderBlock(SIZE, 1), _tokens(0), _tokens(1)
    params = _random_params(block, x, e)
    unchanged = np.broadcast_to(e, (TOKENS + 1, TOKENS, SIZE))
    by_input = _dependence(_apply(block, params, _variants(x), unchanged))
    np.testing.assert_array_equal(by_input, np.triu(np.ones((TOKENS, TOKENS), bool)))
    unchanged = np.broadcast_to(x, (TOKENS + 1, TOKENS, SIZE))
    by_encoding = _dependence(_apply(block, params, unchanged, _variants(e)))
    np.testing.assert_array_equal(by_encoding, np.eye(TOKENS, dtype=bool))


def test_every_encoder_output_depends_on_every_token():
    block, x = EncoderBlock(SIZE, 1), _tokens()
    assert _dependence(_apply(block, _random_params(block, x), _variants(x))).all()


def test_encoder_treats_tokens_alike():
    # No positional embedding: permuting the tokens permutes the outputs.
    block, x = EncoderBlock(SIZE, 1), _tokens()
    params, order = _random_params(block, x), np.array([2, 0, 3, 1])
    straight, permuted = _apply(block, params, np.stack([x, x[order]]))
    assert_allclose(permuted, straight[order], atol=1e-5)


def _gains(params):
    """Singular values of every kernel, by path; each must be a single number."""
    gains = {}
    for path, kernel in jax.tree_util.tree_leaves_with_path(params["params"]):
        if path[-1].key == "kernel":
            values = np.linalg.svd(kernel, compute_uv=False)
            assert_allclose(values, values[0], rtol=1e-3)
            gains["/".join(p.key for p in path[:-1])] = values[0]
    return gains


def test_initial_gains_are_sqrt_2_before_a_gelu_and_0_01_elsewhere():
    x = _tokens()
    attention = Attention(SIZE, 1, True)
    gains = _gains(_init(attention, x, x))
    assert gains == pytest.approx(
        {"query": 0.01, "key": 0.01, "value": 0.01, "output": 0.01}, rel=1e-3
    )
    feed_forward, head = _gains(_init(FeedForward(SIZE), x)), _gains(_init(Head(3, SIZE), x))
    # As above, Dense_1 is the first layer of the feed-forward network.
    assert feed_forward == pytest.approx({"Dense_1": np.sqrt(2), "Dense_0": 0.01}, rel=1e-3)
    assert head == pytest.approx({"Dense_0": np.sqrt(2), "Dense_1": 0.01}, rel=1e-3)


def test_head_is_linear_gelu_norm_linear():
    head, x = Head(3, SIZE), _tokens()
    params = _random_params(head, x)
    p = params["params"]
    expected = _linear(_norm(_gelu(_linear(x, p["Dense_0"])), p["LayerNorm_0"]), p["Dense_1"])
    assert_allclose(_apply(head, params, x), expected, atol=1e-4)
