"""Encoder and decoder blocks of the Multi-Agent Transformer (MAT `ma_transformer.py`).

Post-norm, no dropout, no positional embedding. Linear layers that feed a GELU are orthogonal with
gain sqrt(2); all others have gain 0.01.
"""

import jax
import jax.numpy as jnp
from flax import linen as nn
from jaxtyping import Array, Float

from hmasd_jax.networks import MASKED_LOGIT, RELU_GAIN, LayerNorm, dense

SMALL_GAIN = 0.01


def gelu(x: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
    """GELU in its exact form, PyTorch's default (JAX's is the tanh approximation)."""
    return nn.gelu(x, approximate=False)


class Attention(nn.Module):
    """Multi-head attention; causal if token i may only look at tokens up to i."""

    size: int
    num_heads: int
    causal: bool

    @nn.compact
    def __call__(
        self, query: Float[Array, "*batch tokens size"], key: Float[Array, "*batch tokens size"]
    ) -> Float[Array, "*batch tokens size"]:
        """Attend from `query` to `key`, which also serves as the values."""

        def heads(x, name):
            x = dense(self.size, SMALL_GAIN, name=name)(x)
            return x.reshape(*x.shape[:-1], self.num_heads, -1)

        q, k, v = heads(query, "query"), heads(key, "key"), heads(key, "value")
        scores = jnp.einsum("...qhd,...khd->...hqk", q, k) / jnp.sqrt(q.shape[-1])
        if self.causal:
            allowed = jnp.tril(jnp.ones(scores.shape[-2:], bool))
            scores = jnp.where(allowed, scores, MASKED_LOGIT)
        y = jnp.einsum("...hqk,...khd->...qhd", jax.nn.softmax(scores), v)
        return dense(self.size, SMALL_GAIN, name="output")(y.reshape(*y.shape[:-2], -1))


class FeedForward(nn.Module):
    """Linear, GELU, Linear, all of the same width."""

    size: int

    @nn.compact
    def __call__(self, x: Float[Array, "*batch size"]) -> Float[Array, "*batch size"]:
        """Transform each token."""
        return dense(self.size, SMALL_GAIN)(gelu(dense(self.size, RELU_GAIN)(x)))


class EncoderBlock(nn.Module):
    """x <- LN(x + Attn(x)); x <- LN(x + MLP(x)). Every token sees every other."""

    size: int
    num_heads: int

    @nn.compact
    def __call__(self, x: Float[Array, "*batch tokens size"]) -> Float[Array, "*batch tokens size"]:
        """Encode all tokens."""
        x = LayerNorm()(x + Attention(self.size, self.num_heads, causal=False)(x, x))
        return LayerNorm()(x + FeedForward(self.size)(x))


class DecoderBlock(nn.Module):
    """x <- LN(x + CausalAttn(x)); x <- LN(e + CausalAttn(e, x)); x <- LN(x + MLP(x)).

    e are the encoder's tokens. They query the second attention and carry its residual, so
    token i of the output depends on e_i and on decoder inputs 0..i.
    """

    size: int
    num_heads: int

    @nn.compact
    def __call__(
        self, x: Float[Array, "*batch tokens size"], encoded: Float[Array, "*batch tokens size"]
    ) -> Float[Array, "*batch tokens size"]:
        """Decode all tokens at once."""
        x = LayerNorm()(x + Attention(self.size, self.num_heads, causal=True)(x, x))
        attended = Attention(self.size, self.num_heads, causal=True)(encoded, x)
        x = LayerNorm()(encoded + attended)
        return LayerNorm()(x + FeedForward(self.size)(x))


class Head(nn.Module):
    """Linear, GELU, LayerNorm, Linear with a small gain: MAT's output head."""

    num_outputs: int
    size: int

    @nn.compact
    def __call__(self, x: Float[Array, "*batch size"]) -> Float[Array, "*batch outputs"]:
        """Outputs per token."""
        x = LayerNorm()(gelu(dense(self.size, RELU_GAIN)(x)))
        return dense(self.num_outputs, SMALL_GAIN)(x)
