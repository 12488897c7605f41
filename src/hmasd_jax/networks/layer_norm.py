"""LayerNorm with PyTorch's epsilon, and linear layers that apply the LayerNorm before them."""

import jax
import jax.numpy as jnp
from flax import linen as nn
from jaxtyping import Array, Float

from hmasd_jax.networks.initializers import orthogonal

EPSILON = 1e-5


def rows(x: Float[Array, "*batch features"]) -> Float[Array, "rows features"]:
    """Merge all leading axes: the same numbers, but XLA trains on them a fifth faster on a CPU."""
    return x.reshape(-1, x.shape[-1])


class LayerNorm(nn.Module):
    """LayerNorm over the last axis."""

    def __call__(self, x: Float[Array, "*batch features"]) -> Float[Array, "*batch features"]:
        """Normalize, then scale and shift."""
        scale, shift = self.scale_and_shift(x.shape[-1])
        return standardize(x) * scale + shift

    @nn.compact
    def scale_and_shift(
        self, features: int
    ) -> tuple[Float[Array, " features"], Float[Array, " features"]]:
        """Return the two learned vectors."""
        scale = self.param("scale", nn.initializers.ones_init(), (features,))
        return scale, self.param("bias", nn.initializers.zeros_init(), (features,))


class NormedDense(nn.Module):
    """LayerNorm and the linear layer behind it: orthogonal weights of the given gain, zero bias.

    The scale and shift of the LayerNorm are folded into the weights, which are few, instead of
    applied to the inputs, whose rows are many. The gradient of scale and shift then does not pass
    through the inputs either.
    """

    features: int
    gain: float
    norm: LayerNorm

    def __call__(
        self,
        x: Float[Array, "*batch inputs"],
        more: Float[Array, "*batch more"] | None = None,
    ) -> Float[Array, "*batch features"]:
        """Map the normalized `x`, joined by features `more` that are not normalized."""
        kernel, bias = self.folded(x.shape[-1], 0 if more is None else more.shape[-1])
        x = standardize(x)
        if more is not None:
            x = jnp.concatenate([x, more], axis=-1)
        return x @ kernel + bias

    @nn.compact
    def folded(
        self, inputs: int, more: int = 0
    ) -> tuple[Float[Array, "inputs features"], Float[Array, " features"]]:
        """Return a kernel and a bias that act on standardized inputs."""
        scale, shift = self.norm.scale_and_shift(inputs)
        if more:
            scale = jnp.concatenate([scale, jnp.ones(more)])
            shift = jnp.concatenate([shift, jnp.zeros(more)])
        kernel = self.param("kernel", orthogonal(self.gain), (inputs + more, self.features))
        bias = self.param("bias", nn.initializers.zeros_init(), (self.features,))
        return scale_inputs(kernel, scale), shift @ kernel + bias


@jax.custom_vjp
def scale_inputs(
    kernel: Float[Array, "inputs outputs"], scale: Float[Array, " inputs"]
) -> Float[Array, "inputs outputs"]:
    """Return the weights that act on x as `kernel` acts on x * scale.

    The gradient is written by hand so that it sums with `_mean`. It has no forward mode.
    """
    return scale[:, None] * kernel


def _scale_inputs_gradient(saved, gradient):
    kernel, scale = saved
    return scale[:, None] * gradient, kernel.shape[1] * _mean(gradient * kernel)[:, 0]


scale_inputs.defvjp(
    lambda kernel, scale: (scale_inputs(kernel, scale), (kernel, scale)), _scale_inputs_gradient
)


@jax.custom_vjp
def standardize(x: Float[Array, "*batch features"]) -> Float[Array, "*batch features"]:
    """Shift and scale the last axis to mean 0 and population variance 1, in PyTorch's two passes.

    The gradient is written by hand because it needs only the result and one factor per row. It
    has no forward mode.
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
    """Average the last axis by a matrix product.

    XLA splits a sum into several kernels on a CPU, which are slower to run and to compile.
    """
    average = jnp.full((x.shape[-1], 1), 1.0 / x.shape[-1])
    # "highest" is float32: a GPU's default would round the factors.
    return jnp.matmul(x, average, precision="highest")
