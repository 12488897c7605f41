"""Networks with PyTorch's defaults: those of MAPPO (on-policy, `r_actor_critic`)."""

from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from flax import linen as nn
from jaxtyping import Array, Bool, Float, Int

from hmasd_jax.networks.gru import GRU
from hmasd_jax.networks.initializers import orthogonal
from hmasd_jax.networks.layer_norm import LayerNorm, NormedDense, rows

SkillAt = Literal["input", "last_layer"]

RELU_GAIN = float(np.sqrt(2))
SMALL_GAIN = 0.01
"""Gain of a head whose outputs start out nearly equal."""


def dense(features: int, gain: float, name: str | None = None, use_bias: bool = True) -> nn.Dense:
    """Build a linear layer with orthogonal weights of the given gain and zero bias."""
    init = orthogonal(gain)
    return nn.Dense(features, use_bias=use_bias, kernel_init=init, name=name)


class MLP(nn.Module):
    """Blocks of LayerNorm, Linear, ReLU (on-policy `mlp.py`).

    The reference normalizes the last features too. That LayerNorm is `output_norm`; the layer that
    takes the features applies it.
    """

    hidden_size: int
    num_layers: int = 2

    def setup(self) -> None:
        """Create the layers. Flax names them `LayerNorm_0`, `Dense_0` and so on."""
        self.LayerNorm = [LayerNorm() for _ in range(self.num_layers + 1)]
        norms = self.LayerNorm[: self.num_layers]
        self.Dense = [NormedDense(self.hidden_size, RELU_GAIN, norm) for norm in norms]

    @property
    def output_norm(self) -> LayerNorm:
        """LayerNorm for the features that `__call__` returns."""
        return self.LayerNorm[-1]

    def __call__(self, x: Float[Array, "*batch inputs"]) -> Float[Array, "*batch hidden"]:
        """Map features to hidden features."""
        hidden = rows(x)
        for layer in self.Dense:
            hidden = nn.relu(layer(hidden))
        return hidden.reshape(*x.shape[:-1], -1)


class RecurrentNet(nn.Module):
    """MLP, GRU, LayerNorm, linear head: actor and critic of MAPPO, and of HMASD's discoverer.

    An optional skill joins, as a one-hot vector, either the raw input or the features that enter
    the head. In the latter case it is a constant offset on the outputs: the authors'
    `skill_last_layer`, which the paper does not mention.
    """

    num_outputs: int
    hidden_size: int
    gain: float
    num_skills: int = 0
    skill_at: SkillAt = "input"

    @nn.compact
    def __call__(
        self,
        memory: Float[Array, "*batch hidden"],
        x: Float[Array, "time *batch inputs"],
        first: Bool[Array, "time *batch"],
        skill: Int[Array, "time *batch"] | None = None,
    ) -> tuple[Float[Array, "*batch hidden"], Float[Array, "time *batch outputs"]]:
        """Run over `time` steps. Return the last memory and the outputs of every step.

        Raises:
            ValueError: There is a skill, and `num_skills` is 0.
        """
        if skill is not None and self.num_skills < 1:
            raise ValueError(f"num_skills must be above 0 with a skill, got {self.num_skills}")
        size, steps = self.hidden_size, first.shape
        condition = None if skill is None else jax.nn.one_hot(skill, self.num_skills)
        if condition is not None and self.skill_at == "input":
            x, condition = jnp.concatenate([x, condition], axis=-1), None
        mlp = MLP(size)
        features = mlp(x).reshape(steps[0], -1, size)
        gru = GRU(size, mlp.output_norm)
        memory, x = gru(memory.reshape(-1, size), features, first.reshape(steps[0], -1))
        head = NormedDense(self.num_outputs, self.gain, LayerNorm(), name="head")
        outputs = head(rows(x), None if condition is None else rows(condition))
        return memory.reshape(*steps[1:], size), outputs.reshape(*steps, -1)


class FeedForwardNet(nn.Module):
    """MLP and linear head, called like `RecurrentNet`: on-policy's `mappo` without a memory."""

    num_outputs: int
    hidden_size: int
    gain: float

    @nn.compact
    def __call__(
        self,
        memory: Float[Array, "*batch hidden"],
        x: Float[Array, "time *batch inputs"],
        first: Bool[Array, "time *batch"],
        skill: None = None,
    ) -> tuple[Float[Array, "*batch hidden"], Float[Array, "time *batch outputs"]]:
        """Return the memory unchanged and the outputs of every step."""
        del first, skill
        mlp = MLP(self.hidden_size)
        head = NormedDense(self.num_outputs, self.gain, mlp.output_norm, name="head")
        return memory, head(mlp(x))


def apply(network: nn.Module, params: dict, *inputs: Any, method: str | None = None) -> Any:
    """Call `network.apply`, typed as what the network returns instead of all that flax may."""
    return network.apply(params, *inputs, method=method)
