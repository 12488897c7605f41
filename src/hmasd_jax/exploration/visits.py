"""Parts of episodes, what a part reaches for the first time, and what that is worth."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int


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


def mean_of(total: Float[Array, "*batch"], count: Float[Array, ""]) -> Float[Array, "*batch"]:
    """Return the mean over episodes or parts of them, of which there may be none yet."""
    return total / jnp.maximum(count, 1.0)


def recent_share(
    reached: Float[Array, "*cells"], parts: Float[Array, ""]
) -> Float[Array, "*cells"]:
    """Return the share of recent parts that reached each cell."""
    # Parts under way have reached cells, and do not count yet.
    return jnp.minimum(mean_of(reached, parts), 1.0)


def largest_share(
    mastered: Float[Array, "*cells"],
    reached: Float[Array, "*cells"],
    parts: Float[Array, ""],
    forgetting: float,
) -> Float[Array, "*cells"]:
    """Return the largest share of parts so far that reached each cell, less what is forgotten.

    Args:
        mastered: largest shares before the rollout.
        reached: number of recent parts that reached each cell.
        parts: number of recent parts.
        forgetting: part of the largest share that is forgotten per rollout.
    """
    return jnp.maximum((1.0 - forgetting) * mastered, recent_share(reached, parts))


def odds_against(share: Float[Array, "*cells"], largest: float) -> Float[Array, "*cells"]:
    """Return 1 / p - 1 for a share p of parts, at most `largest`."""
    return jnp.minimum(1.0 / jnp.maximum(share, 1e-9) - 1.0, largest)


def pay(
    is_first: Bool[Array, "*batch cells"], worth: Float[Array, "*#batch cells"]
) -> Float[Array, "*batch"]:
    """Return the worth of all cells that a step reaches first, over the root of their number."""
    number = jnp.maximum(is_first.sum(-1), 1)
    return jnp.where(is_first, worth, 0.0).sum(-1) / jnp.sqrt(number)
