"""MASER (Jeon et al., ICML 2022): subgoals from replay, and a reward for being close to them.

Each agent's subgoal is the observation of the replayed episode at which a mix of its own value and
the total value is highest. Two variants exist. `released` is what the authors' code computes
(`maser_q_learner.py`), whose distance is that of random features, because its optimizer leaves them
out. `paper` trains the features. Unlike in the code, padding is never a subgoal.

Axes are those of `learner`.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from hmasd_jax.baselines.qmix.chunks import over_chunks
from hmasd_jax.baselines.qmix.config import MASERConfig, MASERVariant
from hmasd_jax.baselines.qmix.learner import Values, evaluate_episodes, td_loss
from hmasd_jax.baselines.qmix.networks import MASERNetworks
from hmasd_jax.baselines.qmix.replay import Episodes
from hmasd_jax.rl.ppo import masked_mean
from hmasd_jax.types import Metrics

TINY = 1e-12
"""Added under roots and to norms, whose gradients are not finite at 0."""


def episode_features(
    networks: MASERNetworks, params: dict, episodes: Episodes
) -> Float[Array, "T B N size"]:
    """Return the features of all observations before an action. Those of late padding are 0."""

    def evaluate(params, constants, carry, obs):
        return carry, networks.features(params, obs)

    return over_chunks(evaluate, params, (), (), episodes.seen.obs[:-1], episodes.longest)


def subgoals(
    values: Float[Array, "T B N"],
    total: Float[Array, "T B"],
    valid: Bool[Array, "T B"],
    individual_weight: float,
) -> Int[Array, "B N"]:
    """Return the step of each agent's subgoal: argmax_t alpha Q_i + (1 - alpha) Q_tot / N."""
    share = (total / values.shape[-1])[..., None]
    score = individual_weight * values + (1.0 - individual_weight) * share
    return jnp.where(valid[..., None], score, -jnp.inf).argmax(axis=0)


def at_subgoal(x: Float[Array, "T B N size"], goal: Int[Array, "B N"]) -> Float[Array, "B N size"]:
    """Return `x` at each agent's subgoal."""
    return jnp.take_along_axis(x, goal[None, ..., None], axis=0)[0]


def distances(
    features: Float[Array, "T B N size"], goal: Int[Array, "B N"]
) -> Float[Array, "T B N"]:
    """Return the Euclidean distance of each observation to the agent's subgoal, as features."""
    difference = features - at_subgoal(features, goal)
    return jnp.sqrt((difference**2).sum(-1) + TINY)


def individual_loss(
    values: Values,
    credit: Float[Array, "T B N"],
    reward: Float[Array, "T B"],
    individual_reward: Float[Array, "T B N"],
    episodes: Episodes,
    discount: float,
) -> Float[Array, ""]:
    """Return the agents' squared errors, summed over agents, as a mean over steps.

    The target of agent i is w_i R + r_i + gamma (1 - terminated) Q'_i(t+1). The weights w are a
    softmax of `credit` over agents.
    """
    weight = jax.nn.softmax(credit, axis=-1)
    future = discount * (1.0 - episodes.terminated)[..., None] * values.greedy[1:]
    target = weight * reward[..., None] + individual_reward + future
    error = values.taken - jax.lax.stop_gradient(target)
    return masked_mean((error**2).sum(-1), episodes.valid)


def exploration_loss(
    values: Float[Array, "T B N actions"], goal: Int[Array, "B N"], valid: Bool[Array, "T B"]
) -> Float[Array, ""]:
    """Return the divergence of a softmax of the values from uniform, from the subgoal onwards."""
    log_probs = jax.nn.log_softmax(values)
    divergence = (jnp.exp(log_probs) * log_probs).sum(-1) + jnp.log(values.shape[-1])
    after = jnp.arange(len(values))[:, None, None] >= goal
    return masked_mean(divergence, after & valid[..., None])


def distance_loss(
    distance: Float[Array, "T B N"],
    values: Float[Array, "T B N actions"],
    goal: Int[Array, "B N"],
    valid: Bool[Array, "T B"],
) -> Float[Array, ""]:
    """Return the squared error of the distance to 1 - cos(Q_i(t, .), Q_i(subgoal, .))."""
    of_goal = at_subgoal(values, goal)
    lengths = [jnp.sqrt((x**2).sum(-1) + TINY) for x in (values, of_goal)]
    cosine = (values * of_goal).sum(-1) / (lengths[0] * lengths[1])
    error = (distance - (1.0 - cosine)) ** 2
    return masked_mean(error, jnp.broadcast_to(valid[..., None], error.shape))


def shaped_losses(
    values: Values,
    distance: Float[Array, "T B N"],
    credit: Float[Array, "T B N"],
    episodes: Episodes,
    config: MASERConfig,
) -> tuple[Float[Array, ""], Metrics]:
    """Return the team's and the agents' losses for rewards that include the distances."""
    intrinsic = -config.intrinsic_coef * jax.lax.stop_gradient(distance)
    reward = episodes.reward + intrinsic.mean(-1)
    discount = config.q_learning.discount
    loss, metrics = td_loss(values, reward, episodes, discount)
    individual = individual_loss(values, credit, reward, intrinsic, episodes, discount)
    metrics |= {
        "individual_loss": individual,
        "intrinsic_reward": masked_mean(intrinsic.mean(-1), episodes.valid),
    }
    return loss + config.individual_coef * individual, metrics


def released_loss(
    networks: MASERNetworks,
    config: MASERConfig,
    params: dict,
    target_params: dict,
    episodes: Episodes,
) -> tuple[Float[Array, ""], Metrics]:
    """Return the loss that the authors' code trains.

    Credit is that of the next step. The code's other two losses depend on nothing that it trains.
    """
    values = evaluate_episodes(networks, params, target_params, episodes)
    features = episode_features(networks, params, episodes)
    greedy, total = values.greedy[:-1], values.greedy_total[:-1]
    goal = subgoals(greedy, total, episodes.valid, config.individual_weight)
    distance = distances(jax.lax.stop_gradient(features), goal)
    return shaped_losses(values, distance, values.greedy[1:], episodes, config)


def paper_loss(
    networks: MASERNetworks,
    config: MASERConfig,
    params: dict,
    target_params: dict,
    episodes: Episodes,
) -> tuple[Float[Array, ""], Metrics]:
    """Return the loss of the paper.

    The features learn that observations are close if the agent's values there are similar. From
    the subgoal onwards, the values of all actions are made equal. Subgoals are chosen by the total
    value of the actions taken. Credit is that of the same step.
    """
    values = evaluate_episodes(networks, params, target_params, episodes)
    features = episode_features(networks, params, episodes)
    greedy, total = values.greedy[:-1], jax.lax.stop_gradient(values.total)
    goal = subgoals(greedy, total, episodes.valid, config.individual_weight)
    distance, online = distances(features, goal), values.online[:-1]
    loss, metrics = shaped_losses(values, distance, greedy, episodes, config)
    exploration = exploration_loss(online, goal, episodes.valid)
    distance_error = distance_loss(distance, online, goal, episodes.valid)
    loss += config.exploration_coef * exploration + config.distance_coef * distance_error
    metrics |= {"exploration_loss": exploration, "distance_loss": distance_error}
    return loss, metrics


LOSSES: dict[MASERVariant, Callable[..., tuple[Float[Array, ""], Metrics]]] = {
    "released": released_loss,
    "paper": paper_loss,
}
