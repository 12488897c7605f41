"""The skill coordinator pi_h, V_h: a transformer that assigns skills one by one (Sec. 3.2, Eq. 6).

Token 0 stands for the team (state s, team skill Z), token i for agent i (o^i, z^i); arrays of
skills, log-probabilities and values have these 1 + N tokens on their last axis.
"""

from typing import NamedTuple

import jax.numpy as jnp
from flax import linen as nn
from jaxtyping import Array, Bool, Float, Int

from hmasd_jax.hmasd.config import HMASDConfig
from hmasd_jax.networks.recurrent import RELU_GAIN, apply, dense
from hmasd_jax.networks.transformer import (
    Decode,
    EncoderDecoder,
    Head,
    decoder_inputs,
    draw_in_turn,
)
from hmasd_jax.rl.categorical import categorical, mask_logits
from hmasd_jax.rl.ppo import ppo_loss
from hmasd_jax.rl.value_norm import ValueNorm, normalize
from hmasd_jax.types import Key, Metrics


class Assignment(NamedTuple):
    """Skills for the next k steps, with the statistics of their draw that the update needs."""

    skills: Int[Array, "*batch tokens"]
    """Z, then z^1..z^N."""
    log_prob: Float[Array, "*batch tokens"]
    value: Float[Array, "*batch tokens"]
    """V_h of each token, in normalized units."""

    @property
    def team_skill(self) -> Int[Array, "*batch"]:
        """Team skill Z."""
        return self.skills[..., 0]

    @property
    def individual_skills(self) -> Int[Array, "*batch N"]:
        """Individual skills z^1..z^N."""
        return self.skills[..., 1:]


class HighBatch(NamedTuple):
    """One segment per sample."""

    state: Float[Array, "S state"]
    obs: Float[Array, "S N obs"]
    assignment: Assignment
    advantage: Float[Array, "S tokens"]
    target: Float[Array, "S tokens"]
    """Returns in reward units."""


class Coordinator(EncoderDecoder):
    """Transformer pi_h, V_h with one output head for all tokens, masked to the legal skills."""

    num_team_skills: int
    num_skills: int

    def setup(self) -> None:
        """Create the layers. Team and agents have separate embeddings."""
        super().setup()
        self.embed_state, self.embed_obs = self.embedding(), self.embedding()
        self.embed_team_skill = dense(self.size, RELU_GAIN, use_bias=False)
        self.embed_skill = dense(self.size, RELU_GAIN, use_bias=False)
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
        """Return logits of every token given the skills before it, and V_h of every token."""
        encoded, value = self.encode(state, obs)
        return self.decode(encoded, skills), value

    def encode(
        self, state: Float[Array, "*batch state"], obs: Float[Array, "*batch N obs"]
    ) -> tuple[Float[Array, "*batch tokens size"], Float[Array, "*batch tokens"]]:
        """Encode (s, o^1..o^N) into tokens and V_h of each, in normalized units."""
        tokens = [self.embed_state(state)[..., None, :], self.embed_obs(obs)]
        return self.encode_tokens(jnp.concatenate(tokens, axis=-2))

    def decode(
        self, encoded: Float[Array, "*batch tokens size"], skills: Int[Array, "*batch tokens"]
    ) -> Float[Array, "*batch tokens skills"]:
        """Return the logits of token i given skills 0..i-1. Later skills have no effect."""
        inputs = decoder_inputs(skills, self.max_skills)
        embedded = [self.embed_team_skill(inputs[..., :2, :]), self.embed_skill(inputs[..., 2:, :])]
        x = self.decode_tokens(jnp.concatenate(embedded, axis=-2), encoded)
        return mask_logits(self.skill_head(x), self.legal_skills(skills))

    def legal_skills(
        self, skills: Int[Array, "*batch tokens"]
    ) -> Bool[Array, "*#batch tokens skills"]:
        """Mark the skills that each token may have: n_Z for the team, n_z for an agent."""
        counts = jnp.array([self.num_team_skills] + [self.num_skills] * (skills.shape[-1] - 1))
        return jnp.arange(self.max_skills) < counts[:, None]

    def equal_logits(
        self, skills: Int[Array, "*batch tokens"]
    ) -> Float[Array, "*batch tokens skills"]:
        """Return the same logit for every legal skill."""
        legal = self.legal_skills(skills)
        return mask_logits(jnp.zeros((*skills.shape, self.max_skills)), legal)

    @nn.nowrap
    def draw(
        self,
        decode: Decode,
        shape: tuple[int, ...],
        key: Key,
        greedy: bool | Bool[Array, "*batch"],
        allowed: Bool[Array, "tokens skills"] | None,
    ) -> tuple[Int[Array, "*batch tokens"], Float[Array, "*batch tokens"]]:
        """Draw the skills of all tokens and their log-probabilities, as in `draw_in_turn`."""
        return draw_in_turn(decode, shape, key, greedy, allowed)


def assign(
    network: Coordinator,
    params: dict,
    state: Float[Array, "*batch state"],
    obs: Float[Array, "*batch N obs"],
    key: Key,
    greedy: bool | Bool[Array, "*batch"] = False,
    allowed: Bool[Array, "tokens skills"] | None = None,
) -> Assignment:
    """Algorithm 1, "Sample skills": draw Z ~ pi_h(.|s, o), then each z^i given those before it.

    Args:
        network: coordinator.
        params: its parameters.
        state: global state.
        obs: observations of all agents.
        key: PRNG key of the draws.
        greedy: where True, take the most likely skills instead of sampling.
        allowed: skills that each token may get, at least one per token; None allows all.
    """
    encoded, value = apply(network, params, state, obs, method="encode")

    def decode(skills):
        return apply(network, params, encoded, skills, method="decode")

    # Illegal skills have probability 0, so every draw is legal.
    skills, log_prob = network.draw(decode, value.shape, key, greedy, allowed)
    return Assignment(skills=skills, log_prob=log_prob, value=value)


def coordinator_loss(
    params: dict,
    network: Coordinator,
    norm: ValueNorm,
    batch: HighBatch,
    config: HMASDConfig,
    entropy_coef: float | Float[Array, ""] | None = None,
) -> tuple[Float[Array, ""], Metrics]:
    """Eq. 6: L_h = L_PPO{pi_h(Z), V_h(s)} + sum_i L_PPO{pi_h(z^i), V_h(o^i)} - lambda_h H.

    pi_h(Z|s, o) and pi_h(z^i|s, o, Z, z^{<i}) both receive the reward r^h. H sums their entropies.

    Every token has its own ratio, clip, advantage and value. The sum over tokens is a mean, like in
    the authors' code; the weights are equal either way. `entropy_coef` overrides lambda_h of the
    configuration.
    """
    if entropy_coef is None:
        entropy_coef = config.high_entropy_coef
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
    return loss - entropy_coef * entropy.mean(), metrics
