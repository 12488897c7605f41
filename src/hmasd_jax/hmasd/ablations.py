"""What the ablations NoIndi and NoHigh of the paper (Sec. 4.3) have in the coordinator's place.

The other three ablations are settings: NoTeam has `num_team_skills = 1`, NoExRew
`extrinsic_coef = 0`, NoInRew neither of the two intrinsic coefficients.
"""

from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from hmasd_jax.hmasd.config import CoordinatorKind, HMASDConfig
from hmasd_jax.hmasd.coordinator import Coordinator
from hmasd_jax.rl.categorical import mask_logits


class TeamOnlyCoordinator(Coordinator):
    """NoIndi: assigns Z only, and z^i = Z to every agent, so that the actor sees the team's skill.

    An agent's token has a single legal skill: its log-probability and its entropy are 0, and no
    gradient of Eq. 6 comes from it.
    """

    def legal_skills(
        self, skills: Int[Array, "*batch tokens"]
    ) -> Bool[Array, "*batch tokens skills"]:
        """All at the team's token, Z at those of the agents."""
        is_team_skill = skills[..., :1, None] == jnp.arange(self.max_skills)
        is_team_token = jnp.arange(skills.shape[-1])[:, None] == 0
        return is_team_token | is_team_skill


class RandomCoordinator(Coordinator):
    """NoHigh: draws every skill uniformly, in evaluation too.

    There is nothing to learn but V_h, which nothing depends on.
    """

    always_samples: ClassVar[bool] = True

    def decode(
        self, encoded: Float[Array, "*batch tokens size"], skills: Int[Array, "*batch tokens"]
    ) -> Float[Array, "*batch tokens skills"]:
        """The same logit for every legal skill."""
        legal = self.legal_skills(skills)
        return mask_logits(jnp.zeros((*encoded.shape[:-1], self.max_skills)), legal)


COORDINATORS: dict[CoordinatorKind, type[Coordinator]] = {
    "learned": Coordinator,
    "team_only": TeamOnlyCoordinator,
    "random": RandomCoordinator,
}


def make_coordinator(config: HMASDConfig) -> Coordinator:
    """The coordinator's network."""
    return COORDINATORS[config.coordinator](
        config.num_team_skills,
        config.num_skills,
        config.ppo.hidden_size,
        config.num_blocks,
        config.num_heads,
    )
