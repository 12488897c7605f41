"""Coordinators of the ablations NoIndi and NoHigh (Sec. 4.3).

The other three ablations are settings. NoTeam sets `num_team_skills = 1`, NoExRew sets
`extrinsic_coef = 0`, and NoInRew sets both intrinsic coefficients to 0.
"""

import jax.numpy as jnp
from flax import linen as nn
from jaxtyping import Array, Bool, Float, Int

from hmasd_jax.hmasd.config import CoordinatorKind, HMASDConfig
from hmasd_jax.hmasd.coordinator import Coordinator
from hmasd_jax.networks.transformer import draw_in_turn


class TeamOnlyCoordinator(Coordinator):
    """NoIndi: assign Z only, and z^i = Z to every agent, so that the actor sees the team skill.

    An agent's token has a single legal skill. Its log-probability and entropy are 0, and it
    contributes no gradient to Eq. 6.
    """

    def legal_skills(
        self, skills: Int[Array, "*batch tokens"]
    ) -> Bool[Array, "*batch tokens skills"]:
        """Allow every skill at the team's token, and Z alone at the agents' tokens."""
        is_team_skill = skills[..., :1, None] == jnp.arange(self.max_skills)
        is_team_token = jnp.arange(skills.shape[-1])[:, None] == 0
        return is_team_token | is_team_skill


class RandomCoordinator(Coordinator):
    """NoHigh: draw every skill uniformly, in evaluation too.

    In the paper's ablation skills last for a whole episode. That takes two settings more:
    `segment_clock = "episode"` and a `skill_interval` of the longest episode. Only V_h learns, and
    nothing depends on it.
    """

    def decode(
        self, encoded: Float[Array, "*batch tokens size"], skills: Int[Array, "*batch tokens"]
    ) -> Float[Array, "*batch tokens skills"]:
        """Return the same logit for every legal skill."""
        del encoded
        return self.equal_logits(skills)

    @nn.nowrap
    def draw(self, decode, shape, key, greedy, allowed):
        """Draw skills even where the most likely ones are asked for."""
        del greedy
        return draw_in_turn(decode, shape, key, greedy=False, allowed=allowed)


COORDINATORS: dict[CoordinatorKind, type[Coordinator]] = {
    "learned": Coordinator,
    "team_only": TeamOnlyCoordinator,
    "random": RandomCoordinator,
}


def make_coordinator(config: HMASDConfig) -> Coordinator:
    """Build the coordinator that `config.coordinator` names."""
    return COORDINATORS[config.coordinator](
        size=config.ppo.hidden_size,
        num_blocks=config.num_blocks,
        num_heads=config.num_heads,
        num_team_skills=config.num_team_skills,
        num_skills=config.num_skills,
    )
