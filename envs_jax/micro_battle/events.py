"""Events of `micro_battle`, read from the units before and after an environment step."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from envs_jax.micro_battle.physics import Units, points_left


def count(
    before: Units, after: Units, num_agents: int, ticks: int
) -> dict[str, Float[Array, " agents"]]:
    """Count attacks begun, kills, damage and deaths of each agent in one environment step.

    All that an enemy lost in the step counts for the agent that hit it last, so that sums over
    agents are exact. Damage is in points of health and shield.

    Args:
        before: Units before the step.
        after: Units after the step.
        num_agents: Number of allies, which come first.
        ticks: Length of the step.
    """
    was, left = points_left(before), points_left(after)
    loss = jnp.maximum(was - left, 0)  # Shields recharge.
    dies = (before.health > 0) & (after.health <= 0)
    hit_by = after.shooter[num_agents:, None] == jnp.arange(num_agents)
    begun = after.begun[:num_agents]  # In ticks from the end of the step.
    counts = {
        "attack begun": (begun >= -ticks) & (begun < 0),
        "kill": (hit_by & dies[num_agents:, None]).sum(0),
        "damage dealt": jnp.where(hit_by, loss[num_agents:, None], 0).sum(0),
        "damage taken": loss[:num_agents],
        "death": dies[:num_agents],
    }
    return {name: value.astype(jnp.float32) for name, value in counts.items()}
