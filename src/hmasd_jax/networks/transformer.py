"""Encoder and decoder of the Multi-Agent Transformer (MAT `ma_transformer.py`).

Blocks normalize after the residual. There is no dropout and no positional embedding. Linear layers
that feed a GELU are orthogonal with gain sqrt(2); all others have gain 0.01.
"""

import math
from collections.abc import Callable

import jax
import jax.numpy as jnp
from flax import linen as nn
from jaxtyping import Array, Bool, Float, Int

from hmasd_jax.networks.layer_norm import LayerNorm, NormedDense
from hmasd_jax.networks.recurrent import RELU_GAIN, SMALL_GAIN, dense
from hmasd_jax.rl.categorical import MASKED_LOGIT, categorical, choose
from hmasd_jax.types import Key


def gelu(x: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
    """Exact GELU by erf, like PyTorch's. JAX's own uses erfc and compiles to more kernels."""
    return 0.5 * x * (1.0 + jax.lax.erf(x * math.sqrt(0.5)))


class Attention(nn.Module):
    """Multi-head attention. If causal, token i attends to tokens up to i only."""

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
        """Return the outputs of every token."""
        hidden = gelu(dense(self.size, RELU_GAIN)(x))
        return NormedDense(self.num_outputs, SMALL_GAIN, LayerNorm(), name="Dense_1")(hidden)


class EncoderDecoder(nn.Module):
    """Encoder with a value head, and decoder for choices that are made one by one.

    MAT and HMASD's coordinator add their own embeddings and their own output head.
    """

    size: int
    num_blocks: int
    num_heads: int

    def setup(self) -> None:
        """Create the shared layers. Subclasses call this and add theirs."""
        blocks = range(self.num_blocks)
        self.encoder_norm = LayerNorm()
        self.encoder_blocks = [EncoderBlock(self.size, self.num_heads) for _ in blocks]
        self.value_head = Head(1, self.size)
        self.decoder_norm = LayerNorm()
        self.decoder_blocks = [DecoderBlock(self.size, self.num_heads) for _ in blocks]

    def embedding(self) -> nn.Sequential:
        """Build an embedding of raw inputs: LayerNorm, Linear, GELU."""
        return nn.Sequential([LayerNorm(), dense(self.size, RELU_GAIN), gelu])

    def encode_tokens(
        self, embedded: Float[Array, "*batch tokens size"]
    ) -> tuple[Float[Array, "*batch tokens size"], Float[Array, "*batch tokens"]]:
        """Encode embedded tokens. Return them and a value of each, in normalized units."""
        x = self.encoder_norm(embedded)
        for block in self.encoder_blocks:
            x = block(x)
        return x, self.value_head(x)[..., 0]

    def decode_tokens(
        self,
        embedded: Float[Array, "*batch tokens size"],
        encoded: Float[Array, "*batch tokens size"],
    ) -> Float[Array, "*batch tokens size"]:
        """Decode embedded choices, before their GELU, given the encoder's tokens."""
        x = self.decoder_norm(gelu(embedded))
        for block in self.decoder_blocks:
            x = block(x, encoded)
        return x


def decoder_inputs(
    choices: Int[Array, "*batch tokens"], num_choices: int
) -> Float[Array, "*batch tokens inputs"]:
    """Return one-hot choices shifted by one: the start symbol (index 0), then all but the last."""
    start = jnp.zeros_like(choices[..., :1])
    inputs = jnp.concatenate([start, choices[..., :-1] + 1], axis=-1)
    return jax.nn.one_hot(inputs, num_choices + 1)


Decode = Callable[[Int[Array, "*batch tokens"]], Float[Array, "*batch tokens choices"]]
"""Maps choices to the logits of all tokens. Those of token i depend on choices 0..i-1 only."""


def draw_in_turn(
    decode: Decode,
    shape: tuple[int, ...],
    key: Key,
    greedy: bool | Bool[Array, "*batch"] = False,
    allowed: Bool[Array, "tokens choices"] | None = None,
) -> tuple[Int[Array, "*batch tokens"], Float[Array, "*batch tokens"]]:
    """Choose for one token after another, each given the choices before it.

    Args:
        decode: logits of all tokens, given choices.
        shape: (*batch, tokens).
        key: PRNG key of the draws.
        greedy: where True, take the most likely choice instead of sampling.
        allowed: choices that each token may make, at least one per token; None allows all. A
            token makes an illegal choice if no other is allowed.

    Returns:
        Choices, and their log-probabilities among all choices.
    """

    def draw(choices, inputs):
        token, key = inputs
        logits = jnp.take(decode(choices), token, axis=-2)
        distribution = limited = categorical(logits)
        if allowed is not None:  # Below the finite logit of illegal choices.
            limited = categorical(jnp.where(allowed[token], logits, -jnp.inf))
        choice = choose(limited, greedy, key)
        return choices.at[..., token].set(choice), distribution.log_prob(choice)

    tokens = shape[-1]
    # A scan, so that the decoder is compiled once rather than once per token.
    choices, log_prob = jax.lax.scan(
        draw, jnp.zeros(shape, int), (jnp.arange(tokens), jax.random.split(key, tokens))
    )
    return choices, jnp.moveaxis(log_prob, 0, -1)
