"""LayerNorm with PyTorch's epsilon, by itself and joined with the linear layer behind it."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from flax import linen as nn
from jaxtyping import Array, Float

from hmasd_jax.networks.initializers import orthogonal

EPSILON = 1e-5


class Normed(NamedTuple):
    """What a LayerNorm makes, `x * scale + shift`, before it is multiplied and added.

    A linear layer behind it can do that with its weights, which are few, instead of with x, whose
    rows are many: `NormedDense`. Nor does its gradient then go through x to reach the two.
    """

    x: Float[Array, "*batch features"]
    scale: Float[Array, " features"]
    shift: Float[Array, " features"]


class LayerNorm(nn.Module):
    """LayerNorm over the last axis."""

    @nn.compact
    def __call__(self, x: Float[Array, "*batch features"]) -> Float[Array, "*batch features"]:
        """Normalize, then scale and shift."""
        x, scale, shift = self.in_parts(x)
        return x * scale + shift

    @nn.compact
    def in_parts(self, x: Float[Array, "*batch features"]) -> Normed:
        """Normalize, and leave scale and shift to the next layer."""
        scale = self.param("scale", nn.initializers.ones_init(), x.shape[-1:])
        shift = self.param("bias", nn.initializers.zeros_init(), x.shape[-1:])
        return Normed(standardize(x), scale, shift)


class NormedDense(nn.Module):
    """Linear layer behind a LayerNorm: orthogonal weights of the given gain, zero bias."""

    features: int
    gain: float

    @nn.compact
    def __call__(self, inputs: Normed) -> Float[Array, "*batch outputs"]:
        """(x * scale + shift) @ kernel + bias."""
        kernel, bias = self.weights(inputs)
        return inputs.x @ kernel + bias

    @nn.compact
    def weights(
        self, inputs: Normed
    ) -> tuple[Float[Array, "features outputs"], Float[Array, " outputs"]]:
        """Kernel and bias that act on `inputs.x` as the layer does on `inputs`."""
        init = orthogonal(self.gain)
        kernel = self.param("kernel", init, (inputs.scale.size, self.features))
        bias = self.param("bias", nn.initializers.zeros_init(), (self.features,))
        return scale_inputs(kernel, inputs.scale), inputs.shift @ kernel + bias


@jax.custom_vjp
def scale_inputs(
    kernel: Float[Array, "features outputs"], scale: Float[Array, " features"]
) -> Float[Array, "features outputs"]:
    """Weights that act on x as `kernel` does on x * scale.

    The gradient is written down to sum as `_mean` does. Not for forward-mode differentiation.
    """
    return scale[:, None] * kernel


def _scale_inputs_gradient(saved, gradient):
    kernel, scale = saved
    return scale[:, None] * gradient, kernel.shape[1] * _mean(gradient * kernel)[:, 0]


scale_inputs.defvjp(
    lambda kernel, scale: (scale_inputs(kernel, scale), (kernel, scale)), _scale_inputs_gradient
)


def join(inputs: Normed, more: Float[Array, "*batch more"]) -> Normed:
    """Inputs with more features, which are not normalized."""
    return Normed(
        jnp.concatenate([inputs.x, more], axis=-1),
        jnp.concatenate([inputs.scale, jnp.ones(more.shape[-1])]),
        jnp.concatenate([inputs.shift, jnp.zeros(more.shape[-1])]),
    )


@jax.custom_vjp
def standardize(x: Float[Array, "*batch features"]) -> Float[Array, "*batch features"]:
    """Mean 0 and (population) variance 1 over the last axis, as PyTorch's two passes have it.

    The gradient is written down, as it needs the result and a factor per row only. Not for
    forward-mode differentiation.
    """
    return _standardize(x)[0]


def _standardize(x):
    deviation = x - _mean(x)
    factor = jax.lax.rsqrt(_mean(deviation**2) + EPSILON)
    standardized = deviation * factor
    return standardized, (standardized, factor)


def _standardize_gradient(saved, gradient):
    x, factor = saved
    return (factor * (gradient - _mean(gradient) - x * _mean(gradient * x)),)


standardize.defvjp(_standardize, _standardize_gradient)


def _mean(x: Float[Array, "*batch features"]) -> Float[Array, "*batch 1"]:
    """As a matrix product: XLA splits a sum into several programs, slower to run and compile."""
    average = jnp.full((x.shape[-1], 1), 1.0 / x.shape[-1])
    # "highest" is float32: a GPU's default would round the factors.
    return jnp.matmul(x, average, precision="highest")
