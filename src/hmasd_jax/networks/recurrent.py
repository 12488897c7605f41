"""Building blocks with PyTorch's defaults: the networks of MAPPO (on-policy, `r_actor_critic`)."""

from typing import Any, Literal

import jax.numpy as jnp
import numpy as np
from flax import linen as nn
from jaxtyping import Array, Bool, Float

from hmasd_jax.networks.gru import GRU
from hmasd_jax.networks.initializers import orthogonal
from hmasd_jax.networks.layer_norm import LayerNorm, Normed, NormedDense, join

ConditionAt = Literal["input", "last_layer"]

RELU_GAIN = float(np.sqrt(2))


def dense(features: int, gain: float, name: str | None = None, use_bias: bool = True) -> nn.Dense:
    """Linear layer with orthogonal weights of the given gain and zero bias."""
    init = orthogonal(gain)
    return nn.Dense(features, use_bias=use_bias, kernel_init=init, name=name)


def rows(x: Float[Array, "*batch features"]) -> Float[Array, "rows features"]:
    """All leading axes as one: the same numbers, but XLA trains on them a fifth faster on a CPU."""
    return x.reshape(-1, x.shape[-1])


class MLP(nn.Module):
    """LayerNorm on the input, then blocks of Linear, ReLU, LayerNorm (on-policy `mlp.py`)."""

    hidden_size: int
    num_layers: int = 2

    @nn.compact
    def __call__(self, x: Float[Array, "*batch inputs"]) -> Normed:
        """Map features to hidden features, whose scale and shift are left to the next layer."""
        hidden = LayerNorm().in_parts(rows(x))
        for i in range(self.num_layers):
            linear = NormedDense(self.hidden_size, RELU_GAIN, name=f"Dense_{i}")
            hidden = LayerNorm().in_parts(nn.relu(linear(hidden)))
        return hidden._replace(x=hidden.x.reshape(*x.shape[:-1], -1))


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
        features = MLP(size)(x)
        features = features._replace(x=features.x.reshape(steps[0], -1, size))
        memory, x = GRU(size)(memory.reshape(-1, size), features, first.reshape(steps[0], -1))
        features = LayerNorm().in_parts(rows(x))
        if condition is not None and self.condition_at == "last_layer":
            features = join(features, rows(condition))
        outputs = NormedDense(self.num_outputs, self.gain, name="head")(features)
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
        features = MLP(self.hidden_size)(x)
        return memory, NormedDense(self.num_outputs, self.gain, name="head")(features)


def apply(network: nn.Module, params: dict, *inputs: Any, method: str | None = None) -> Any:
    """`network.apply` typed as what the network returns, rather than as all flax may return."""
    return network.apply(params, *inputs, method=method)
