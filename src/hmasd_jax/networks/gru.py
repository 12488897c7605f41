"""PyTorch's GRU over time, with memory zeroed where an episode begins (on-policy `rnn.py`)."""

import jax
import jax.numpy as jnp
from flax import linen as nn
from jaxtyping import Array, Bool, Float

from hmasd_jax.networks.initializers import orthogonal
from hmasd_jax.networks.layer_norm import LayerNorm, NormedDense, rows, standardize


class GRU(nn.Module):
    """LayerNorm, then a GRU. Each step does its own matrix products.

    The products of the inputs could be computed for all steps at once. Step by step, their results
    stay in the processor's caches until they are used, which trains faster on a CPU.
    """

    hidden_size: int
    norm: LayerNorm
    """Normalizes the inputs."""

    @nn.compact
    def __call__(
        self,
        memory: Float[Array, "*batch hidden"],
        x: Float[Array, "time *batch features"],
        first: Bool[Array, "time *batch"],
    ) -> tuple[Float[Array, "*batch hidden"], Float[Array, "time *batch hidden"]]:
        """Return the last memory and the memory after every step."""
        size = self.hidden_size
        # Orthogonal as one stacked matrix, not gate by gate: the behavior of PyTorch's initializer.
        layer = NormedDense(3 * size, 1.0, self.norm, name="input")
        input_kernel, input_bias = layer.folded(x.shape[-1])
        kernel = self.param("kernel", orthogonal(1.0), (size, 3 * size))
        bias = self.param("bias", nn.initializers.zeros_init(), (3 * size,))

        def step(h, inputs):
            x, first = inputs
            h = jnp.where(first[..., None], 0.0, h)
            h = gru_cell(h, x @ input_kernel + input_bias, h @ kernel + bias)
            return h, h

        return jax.lax.scan(step, memory, (standardize(rows(x)).reshape(x.shape), first))


@jax.custom_vjp
def gru_cell(
    h: Float[Array, "*batch hidden"],
    from_input: Float[Array, "*batch gates"],
    from_memory: Float[Array, "*batch gates"],
) -> Float[Array, "*batch hidden"]:
    """Return (1 - z) n + z h, with n = tanh(W_n x + b_n + r (U_n h + c_n)) and sigmoids r, z.

    The gradient is written by hand because it needs five arrays, where JAX would keep ten. It has
    no forward mode.

    Args:
        h: memory.
        from_input: W x + b of the gates r, z and the candidate n, side by side.
        from_memory: U h + c of the same.
    """
    return _gru_cell(h, from_input, from_memory)[0]


def _gru_cell(h, from_input, from_memory):
    input_r, input_z, input_n = jnp.split(from_input, 3, axis=-1)
    memory_r, memory_z, memory_n = jnp.split(from_memory, 3, axis=-1)
    r, z = jax.nn.sigmoid(input_r + memory_r), jax.nn.sigmoid(input_z + memory_z)
    n = jnp.tanh(input_n + r * memory_n)
    return (1.0 - z) * n + z * h, (h, r, z, n, memory_n)


def _gru_cell_gradient(saved, gradient):
    h, r, z, n, memory_n = saved
    before_n = gradient * (1.0 - z) * (1.0 - n**2)  # before the tanh
    before_z = gradient * (h - n) * z * (1.0 - z)  # before the sigmoids
    before_r = before_n * memory_n * r * (1.0 - r)
    return (
        gradient * z,
        jnp.concatenate([before_r, before_z, before_n], axis=-1),
        jnp.concatenate([before_r, before_z, before_n * r], axis=-1),
    )


gru_cell.defvjp(_gru_cell, _gru_cell_gradient)
