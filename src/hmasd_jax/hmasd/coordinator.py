"""The skill coordinator pi_h, V_h: a transformer that assigns skills one by one (Sec. 3.2, Eq. 6).

Token 0 stands for the team (state s, team skill Z), token i for agent i (o^i, z^i); arrays of
skills, log-probabilities and values have these 1 + N tokens on their last axis.
"""

from collections.abc import Sequence
from typing import ClassVar, NamedTuple

import jax.numpy as jnp
from flax import linen as nn
from jaxtyping import Array, Bool, Float, Int

from hmasd_jax.hmasd.config import HMASDConfig
from hmasd_jax.networks.layer_norm import LayerNorm
from hmasd_jax.networks.recurrent import RELU_GAIN, apply, dense
from hmasd_jax.networks.transformer import (
    DecoderBlock,
    EncoderBlock,
    Head,
    decoder_inputs,
    draw_in_turn,
    gelu,
)
from hmasd_jax.rl.categorical import categorical, mask_logits
from hmasd_jax.rl.ppo import ppo_loss
from hmasd_jax.rl.value_norm import ValueNorm, normalize
from hmasd_jax.types import Key, Metrics


class Assignment(NamedTuple):
    """Skills for the next k steps, and what the update needs to know about their draw."""

    skills: Int[Array, "*batch tokens"]
    """Z, then z^1..z^N."""
    log_prob: Float[Array, "*batch tokens"]
    value: Float[Array, "*batch tokens"]
    """V_h of each token, in normalized units."""

    @property
    def team_skill(self) -> Int[Array, "*batch"]:
        """Z."""
        return self.skills[..., 0]

    @property
    def individual_skills(self) -> Int[Array, "*batch N"]:
        """z^1..z^N."""
        return self.skills[..., 1:]


class HighBatch(NamedTuple):
    """One segment per sample."""

    state: Float[Array, "S state"]
    obs: Float[Array, "S N obs"]
    assignment: Assignment
    advantage: Float[Array, "S tokens"]
    target: Float[Array, "S tokens"]
    """Returns in reward units."""


class Coordinator(nn.Module):
    """Encoder with value heads, and autoregressive decoder with one masked output head."""

    num_team_skills: int
    num_skills: int
    size: int
    num_blocks: int
    num_heads: int

    always_samples: ClassVar[bool] = False
    """Whether skills are sampled even where the likeliest ones are asked for."""

    def setup(self) -> None:
        """Create the parts; the input embeddings of team and agents are separate."""
        self.embed_state = nn.Sequential([LayerNorm(), dense(self.size, RELU_GAIN), gelu])
        self.embed_obs = nn.Sequential([LayerNorm(), dense(self.size, RELU_GAIN), gelu])
        self.encoder_norm = LayerNorm()
        blocks = range(self.num_blocks)
        self.encoder_blocks = [EncoderBlock(self.size, self.num_heads) for _ in blocks]
        self.value_head = Head(1, self.size)
        self.embed_team_skill = dense(self.size, RELU_GAIN, use_bias=False)
        self.embed_skill = dense(self.size, RELU_GAIN, use_bias=False)
        self.decoder_norm = LayerNorm()
        self.decoder_blocks = [DecoderBlock(self.size, self.num_heads) for _ in blocks]
        self.skill_head = Head(self.max_skills, self.size)

    @property
    def max_skills(self) -> int:
        """Width of the output head that all tokens share."""
        return max(self.num_team_skills, self.num_skills)

    def __call__(
        self,
        state: Float[Array, "*batch state"],
        obs: Float[Array, "*batch N obs"],
        skills: Int[Array, "*batch tokens"],
    ) -> tuple[Float[Array, "*batch tokens skills"], Float[Array, "*batch tokens"]]:
        """Teacher-forced: logits of every token given the skills before it, and all V_h."""
        encoded, value = self.encode(state, obs)
        return self.decode(encoded, skills), value

    def encode(
        self, state: Float[Array, "*batch state"], obs: Float[Array, "*batch N obs"]
    ) -> tuple[Float[Array, "*batch tokens size"], Float[Array, "*batch tokens"]]:
        """Encode (s, o^1..o^N) into tokens and V_h of each, in normalized units."""
        tokens = [self.embed_state(state)[..., None, :], self.embed_obs(obs)]
        x = self.encoder_norm(jnp.concatenate(tokens, axis=-2))
        for block in self.encoder_blocks:
            x = block(x)
        return x, self.value_head(x)[..., 0]

    def decode(
        self, encoded: Float[Array, "*batch tokens size"], skills: Int[Array, "*batch tokens"]
    ) -> Float[Array, "*batch tokens skills"]:
        """Logits of token i given skills 0..i-1; later entries of `skills` have no effect."""
        inputs = decoder_inputs(skills, self.max_skills)
        embedded = [self.embed_team_skill(inputs[..., :2, :]), self.embed_skill(inputs[..., 2:, :])]
        x = self.decoder_norm(gelu(jnp.concatenate(embedded, axis=-2)))
        for block in self.decoder_blocks:
            x = block(x, encoded)
        return mask_logits(self.skill_head(x), self.legal_skills(skills))

    def legal_skills(
        self, skills: Int[Array, "*batch tokens"]
    ) -> Bool[Array, "*#batch tokens skills"]:
        """Which skills each token may have, given those before it: n_Z and n_z differ."""
        counts = jnp.array([self.num_team_skills] + [self.num_skills] * (skills.shape[-1] - 1))
        return jnp.arange(self.max_skills) < counts[:, None]


def assign(
    network: Coordinator,
    params: dict,
    state: Float[Array, "*batch state"],
    obs: Float[Array, "*batch N obs"],
    key: Key,
    greedy: bool = False,
    fixed: Sequence[int | None] | None = None,
) -> Assignment:
    """Algorithm 1, line "Sample skills": Z ~ pi_h(.|s, o), then each z^i given those before it.

    Tokens with a skill in `fixed` (tokens,) get that one; the others are drawn given it.
    """
    encoded, value = apply(network, params, state, obs, method="encode")

    def decode(skills):
        return apply(network, params, encoded, skills, method="decode")

    # Illegal skills have probability 0, so each draw is legal at its token.
    greedy = greedy and not network.always_samples
    skills, log_prob = draw_in_turn(decode, value.shape, key, greedy, fixed)
    return Assignment(skills, log_prob, value)


def coordinator_loss(
    params: dict, network: Coordinator, norm: ValueNorm, batch: HighBatch, config: HMASDConfig
) -> tuple[Float[Array, ""], Metrics]:
    """Eq. 6: L_h = L_PPO{pi_h(Z), V_h(s)} + sum_i L_PPO{pi_h(z^i), V_h(o^i)} - lambda_h H.

    pi_h(Z|s, o) and pi_h(z^i|s, o, Z, z^{<i}) are both rewarded with r^h; H sums their entropies.

    Every token has its own ratio, clip, advantage and value. As in the authors' code the sum over
    tokens is a mean (equal weights either way).
    """
    skills = batch.assignment.skills
    logits, value = apply(network, params, batch.state, batch.obs, skills)
    distribution = categorical(logits)
    loss, metrics = ppo_loss(
        jnp.asarray(distribution.log_prob(skills)),
        batch.assignment.log_prob,
        batch.advantage,
        value,
        batch.assignment.value,
        normalize(norm, batch.target),
        config.ppo,
    )
    entropy = jnp.asarray(distribution.entropy())
    metrics |= {"team_entropy": entropy[..., 0].mean(), "skill_entropy": entropy[..., 1:].mean()}
    return loss - config.high_entropy_coef * entropy.mean(), metrics
