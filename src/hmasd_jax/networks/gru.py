"""PyTorch's GRU over time, whose memory is zeroed where an episode begins (on-policy `rnn.py`)."""

import jax
import jax.numpy as jnp
from flax import linen as nn
from jaxtyping import Array, Bool, Float

from hmasd_jax.networks.initializers import orthogonal
from hmasd_jax.networks.layer_norm import Normed, NormedDense


class GRU(nn.Module):
    """GRU behind a LayerNorm. Each step has its matrix products to itself.

    Those of the inputs could be made for all steps at once; but step by step what is made stays
    in a processor's caches until it is used, which trains faster on a CPU.
    """

    hidden_size: int

    @nn.compact
    def __call__(
        self,
        memory: Float[Array, "*batch hidden"],
        inputs: Normed,
        first: Bool[Array, "time *batch"],
    ) -> tuple[Float[Array, "*batch hidden"], Float[Array, "time *batch hidden"]]:
        """Return the last memory and the memory after every step; `inputs.x` is (time, *batch)."""
        size = self.hidden_size
        # Orthogonal as one stacked matrix, not gate by gate, as PyTorch's initializer does it.
        input_kernel, input_bias = NormedDense(3 * size, 1.0, name="input").weights(inputs)
        kernel = self.param("kernel", orthogonal(1.0), (size, 3 * size))
        bias = self.param("bias", nn.initializers.zeros_init(), (3 * size,))

        def step(h, inputs):
            x, first = inputs
            h = jnp.where(first[..., None], 0.0, h)
            h = gru_cell(h, x @ input_kernel + input_bias, h @ kernel + bias)
            return h, h

        return jax.lax.scan(step, memory, (inputs.x, first))


@jax.custom_vjp
def gru_cell(
    h: Float[Array, "*batch hidden"],
    from_input: Float[Array, "*batch gates"],
    from_memory: Float[Array, "*batch gates"],
) -> Float[Array, "*batch hidden"]:
    """Next memory (1 - z) n + z h, with n = tanh(W_n x + b_n + r (U_n h + c_n)) and r, z sigmoids.

    The gradient is written down, as it can be had from five arrays, of which JAX would keep ten.
    Not for forward-mode differentiation.

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
