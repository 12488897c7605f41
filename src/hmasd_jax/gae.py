"""Generalized advantage estimation (Schulman et al., 2016), below Eq. 5."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float


def gae(
    reward: Float[Array, "T *batch"],
    value: Float[Array, "T *batch"],
    next_value: Float[Array, "T *batch"],
    terminated: Bool[Array, "T *batch"],
    done: Bool[Array, "T *batch"],
    discount: float,
    gae_lambda: float,
) -> tuple[Float[Array, "T *batch"], Float[Array, "T *batch"]]:
    """Advantages Â and targets R̂ = Â + V, by backward recursion.

        δ_t = r_t + γ V'_t (1 - terminated_t) - V_t
        Â_t = δ_t + γ λ (1 - done_t) Â_{t+1}

    `next_value` V'_t is the value of what step t led to, before any reset; where an episode was
    cut by its time limit (`done` without `terminated`) it is bootstrapped from, but no advantage
    flows back over the cut. To treat time limits as terminal, pass `terminated=done`. All values
    are in reward units (denormalized). Inputs broadcast against each other.
    """
    delta = reward + discount * next_value * (1.0 - terminated) - value
    carry_over = jnp.broadcast_to(discount * gae_lambda * (1.0 - done), delta.shape)

    def backward(following, step):
        advantage = step[0] + step[1] * following
        return advantage, advantage

    _, advantage = jax.lax.scan(
        backward, jnp.zeros_like(delta[0]), (delta, carry_over), reverse=True
    )
    return advantage, advantage + value


def normalize_advantage(advantage: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
    """Shift and scale by mean and population standard deviation over all axes.

    Matches on-policy `r_mappo.py`, which does it once per iteration, before the epochs.
    """
    return (advantage - advantage.mean()) / (advantage.std() + 1e-5)
