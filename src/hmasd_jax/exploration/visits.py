"""Parts of episodes, and the bins that a part reaches for the first time."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int


def split_episodes(
    part_steps: Int[Array, " E"], done: Bool[Array, "T E"], period: int
) -> tuple[Int[Array, " E"], Bool[Array, "T E"]]:
    """Split episodes into parts of at most `period` steps, from their beginning.

    Args:
        part_steps: steps of the parts that were under way before the rollout.
        done: whether each step ends an episode.
        period: most steps of a part. With 0 each episode is one part.

    Returns:
        Steps of the parts under way, and whether each step ends a part.
    """

    def step(part_steps, done):
        part_steps = part_steps + 1
        ends = done | (part_steps == period)
        return jnp.where(ends, 0, part_steps), ends

    return jax.lax.scan(step, part_steps, done)


def first_visits(
    visited: Bool[Array, "E 2 state bins"],
    start: Int[Array, "T E state"],
    end: Int[Array, "T E state"],
    part_ends: Bool[Array, "T E"],
) -> tuple[Bool[Array, "E 2 state bins"], Bool[Array, "T E 2 state bins"]]:
    """Return the bins that the parts under way have reached, and those that each step adds.

    A step from bin `start` to bin `end` reaches `end` and all between, rising or falling. A step
    that stays in its bin reaches none.
    """
    bins = jnp.arange(visited.shape[-1])
    start, end = start[..., None], end[..., None]
    rising, falling = (start < bins) & (bins <= end), (end <= bins) & (bins < start)

    def step(visited, x):
        here, ends = x
        return (visited | here) & ~ends[:, None, None, None], here & ~visited

    return jax.lax.scan(step, visited, (jnp.stack([rising, falling], 2), part_ends))
