"""Building blocks with PyTorch's defaults: the networks of MAPPO (on-policy, `r_actor_critic`)."""

from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from flax import linen as nn
from jaxtyping import Array, Bool, Float

ConditionAt = Literal["input", "last_layer"]

RELU_GAIN = float(np.sqrt(2))
MASKED_LOGIT = -1e10
"""Logit of an illegal action: its probability is 0, and gradients stay finite."""


def dense(features: int, gain: float, name: str | None = None, use_bias: bool = True) -> nn.Dense:
    """Linear layer with orthogonal weights of the given gain and zero bias."""
    init = nn.initializers.orthogonal(gain)
    return nn.Dense(features, use_bias=use_bias, kernel_init=init, name=name)


class LayerNorm(nn.Module):
    """LayerNorm over the last axis with PyTorch's epsilon and two-pass variance.

    flax's own computes the same with the deviations from the mean formed twice, which makes
    training the discoverer about 8 % slower on a CPU. Means are matrix products, as XLA splits
    sums over an axis into several programs, which compile and run slower.
    """

    @nn.compact
    def __call__(self, x: Float[Array, "*batch features"]) -> Float[Array, "*batch features"]:
        """Normalize, then scale and shift."""
        scale = self.param("scale", nn.initializers.ones_init(), x.shape[-1:])
        bias = self.param("bias", nn.initializers.zeros_init(), x.shape[-1:])
        average = jnp.full((x.shape[-1], 1), 1.0 / x.shape[-1])
        # "highest" is float32: a GPU's default would round the factors.
        deviation = x - jnp.matmul(x, average, precision="highest")
        variance = jnp.matmul(deviation**2, average, precision="highest")
        return deviation * jax.lax.rsqrt(variance + 1e-5) * scale + bias


def rows(x: Float[Array, "*batch features"]) -> Float[Array, "rows features"]:
    """All leading axes as one: the same numbers, but XLA trains on them a fifth faster on a CPU."""
    return x.reshape(-1, x.shape[-1])


class MLP(nn.Module):
    """LayerNorm on the input, then blocks of Linear, ReLU, LayerNorm (on-policy `mlp.py`)."""

    hidden_size: int
    num_layers: int = 2

    @nn.compact
    def __call__(self, x: Float[Array, "*batch inputs"]) -> Float[Array, "*batch hidden"]:
        """Map features to hidden features."""
        batch, x = x.shape[:-1], rows(x)
        x = LayerNorm()(x)
        for _ in range(self.num_layers):
            x = LayerNorm()(nn.relu(dense(self.hidden_size, RELU_GAIN)(x)))
        return x.reshape(*batch, -1)


class GRU(nn.Module):
    """PyTorch's GRU over time, whose memory is zeroed where an episode begins (`rnn.py`).

    Gates r, z and candidate n from x and h:
    h' = (1 - z) n + z h with n = tanh(W_n x + b_n + r (U_n h + c_n)).
    """

    hidden_size: int

    @nn.compact
    def __call__(
        self,
        memory: Float[Array, "*batch hidden"],
        x: Float[Array, "time *batch hidden"],
        first: Bool[Array, "time *batch"],
    ) -> tuple[Float[Array, "*batch hidden"], Float[Array, "time *batch hidden"]]:
        """Return the last memory and the memory after every step."""
        size = self.hidden_size
        # Orthogonal as one stacked matrix, not gate by gate, as PyTorch's initializer does it.
        orthogonal = nn.initializers.orthogonal(1.0)
        gates = nn.Dense(3 * size, kernel_init=orthogonal, name="input")(rows(x))
        gates = gates.reshape(*x.shape[:-1], -1)
        kernel = self.param("kernel", orthogonal, (size, 3 * size))
        bias = self.param("bias", nn.initializers.zeros_init(), (3 * size,))

        def step(h, inputs):
            gate, first = inputs
            h = jnp.where(first[..., None], 0.0, h)
            gate_r, gate_z, gate_n = jnp.split(gate, 3, axis=-1)
            hidden_r, hidden_z, hidden_n = jnp.split(h @ kernel + bias, 3, axis=-1)
            r, z = jax.nn.sigmoid(gate_r + hidden_r), jax.nn.sigmoid(gate_z + hidden_z)
            h = (1.0 - z) * jnp.tanh(gate_n + r * hidden_n) + z * h
            return h, h

        return jax.lax.scan(step, memory, (gates, first))


class RecurrentNet(nn.Module):
    """MLP, GRU, LayerNorm, linear head: actor and critic of MAPPO, and of HMASD's discoverer.

    The optional condition (a one-hot skill) joins either the raw input or the features that go
    into the head. In the latter case it is a constant offset on the outputs: the authors'
    `skill_last_layer`, which the paper does not mention.
    """

    num_outputs: int
    hidden_size: int
    gain: float
    condition_at: ConditionAt = "input"

    @nn.compact
    def __call__(
        self,
        memory: Float[Array, "*batch hidden"],
        x: Float[Array, "time *batch inputs"],
        first: Bool[Array, "time *batch"],
        condition: Float[Array, "time *batch skills"] | None = None,
    ) -> tuple[Float[Array, "*batch hidden"], Float[Array, "time *batch outputs"]]:
        """Run over `time` steps; returns the last memory and the outputs of every step."""
        size, steps = self.hidden_size, first.shape
        if condition is not None and self.condition_at == "input":
            x = jnp.concatenate([x, condition], axis=-1)
        x = MLP(size)(x).reshape(steps[0], -1, size)
        memory, x = GRU(size)(memory.reshape(-1, size), x, first.reshape(steps[0], -1))
        x = LayerNorm()(rows(x))
        if condition is not None and self.condition_at == "last_layer":
            x = jnp.concatenate([x, rows(condition)], axis=-1)
        outputs = dense(self.num_outputs, self.gain, name="head")(x)
        return memory.reshape(*steps[1:], size), outputs.reshape(*steps, -1)


class FeedForwardNet(nn.Module):
    """MLP and linear head, called as `RecurrentNet` is: on-policy's `mappo` without a memory."""

    num_outputs: int
    hidden_size: int
    gain: float

    @nn.compact
    def __call__(
        self,
        memory: Float[Array, "*batch hidden"],
        x: Float[Array, "time *batch inputs"],
        first: Bool[Array, "time *batch"],
        condition: None = None,
    ) -> tuple[Float[Array, "*batch hidden"], Float[Array, "time *batch outputs"]]:
        """Return the memory as it is and the outputs of every step."""
        del first, condition
        return memory, dense(self.num_outputs, self.gain, name="head")(MLP(self.hidden_size)(x))


def apply(network: nn.Module, params: dict, *inputs: Any, method: str | None = None) -> Any:
    """`network.apply` typed as what the network returns, rather than as all flax may return."""
    return network.apply(params, *inputs, method=method)


def mask_logits(
    logits: Float[Array, "*batch actions"], mask: Bool[Array, "*batch actions"]
) -> Float[Array, "*batch actions"]:
    """Make illegal actions impossible."""
    return jnp.where(mask, logits, MASKED_LOGIT)
