"""Record how well the individual skills of trained runs can be told from what agents do.

python scripts/skill_accuracy.py RUN OUT

All agents hold one skill for whole episodes, and sample their actions. A new classifier of the form
of q_d learns which skill it was from the observations of half of the episodes. OUT (JSON) gets one
row per seed: the share of the steps of the other half at which it is right, and that of its
segments of k steps, the time for which the coordinator assigns a skill. Another classifier judges a
segment by the sum of what it says of its steps. Skills weigh alike, however soon their episodes
end, so chance is 1 / n_z. The accuracy of q_d in training is higher where the coordinator prefers a
skill.
"""

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax

from hmasd_jax.analysis.episodes import play
from hmasd_jax.analysis.skills import Condition, allowed_skills
from hmasd_jax.hmasd.discriminators import Classifier
from hmasd_jax.rl import moments
from hmasd_jax.runs.load import TrainedRun, check_skills, load_run
from scripts.records import record_seeds

EPISODES = 256
"""Episodes per skill. With 64 a classifier learned its own by heart."""
GRADIENT_STEPS = 4000
BATCH = 128
CLIP = 5.0
"""Bound of standardized features."""


def collect(trained: TrainedRun, key: jax.Array) -> tuple[np.ndarray, np.ndarray]:
    """Play with each of n skills in turn.

    Returns:
        Observations after each step (n, episodes, T, N, obs), and whether they count.
    """
    env, config = trained.env, trained.config.algorithm
    counts = config.num_team_skills, config.num_skills

    @jax.jit
    def hold(allowed, keys):
        policy = trained.algorithm.policy(trained.state, False, allowed=allowed)
        played = play(env, policy, keys)
        obs = played.timesteps.obs[:, 1:]
        return obs, jnp.broadcast_to(played.counted[..., None], obs.shape[:-1])

    held = [Condition("held", "individual", z) for z in range(config.num_skills)]
    allowed = [jnp.asarray(allowed_skills(z, *counts, env.num_agents)) for z in held]
    keys = jax.random.split(key, (len(held), EPISODES))
    obs, counted = zip(*(jax.device_get(hold(*x)) for x in zip(allowed, keys)))
    return np.stack(obs), np.stack(counted)


def cut(x: np.ndarray, length: int) -> np.ndarray:
    """Cut (n, episodes, T, N, ...) into segments (n, episodes, segments, `length`, ...).

    A rest of T that is shorter than a segment is left out.
    """
    skills, episodes, steps, agents, *inner = x.shape
    x = x[:, :, : steps // length * length]
    x = x.reshape(skills, episodes, -1, length, agents, *inner).swapaxes(3, 4)
    return x.reshape(skills, episodes, -1, length, *inner)


def classify(obs: np.ndarray, counted: np.ndarray, hidden_size: int, key: jax.Array) -> float:
    """Train on the first half of the episodes, and return the accuracy on the other half.

    The samples of each skill have the same weight in both, however many there are.

    Args:
        obs: Segments (n, episodes, segments, L, obs), as of `cut`.
        counted: Whether a step counts. A segment counts if one of its steps does.
        hidden_size: Units of the classifier's layers.
        key: PRNG key.
    """
    half = obs.shape[1] // 2
    skills = np.broadcast_to(np.arange(len(obs))[:, None, None], counted.shape[:3])

    def select(episodes: slice) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Return the segments that count, which of their steps do, and their skills."""
        counts = counted[:, episodes].any(-1)
        arrays = (x[:, episodes][counts] for x in (obs, counted, skills))
        return tuple(map(jnp.asarray, arrays))

    train, test = select(slice(half)), select(slice(half, None))
    weight = 1.0 / jnp.maximum(jnp.bincount(train[2], length=len(obs)), 1)
    weight = weight * len(train[2]) / len(obs)
    scale = moments.update(moments.Moments.create(obs.shape[-1]), train[0][train[1]])
    network = Classifier(len(obs), hidden_size)
    key, key_init = jax.random.split(key)
    params = network.init(key_init, train[0][:1])
    optimizer = optax.adam(1e-3)

    def log_probs(params, obs, counted):
        each = jnp.asarray(network.apply(params, moments.standardize(scale, obs, CLIP)))
        return jax.nn.log_softmax(jnp.sum(each, axis=-2, where=counted[..., None]))

    def loss_fn(params, obs, counted, skill):
        log_prob = jnp.take_along_axis(log_probs(params, obs, counted), skill[:, None], 1)[:, 0]
        return -(weight[skill] * log_prob).mean()

    def step(carry, key):
        params, opt_state = carry
        pick = jax.random.randint(key, (BATCH,), 0, len(train[0]))
        gradient = jax.grad(loss_fn)(params, *(x[pick] for x in train))
        updates, opt_state = optimizer.update(gradient, opt_state)
        return (optax.apply_updates(params, updates), opt_state), None

    carry = params, optimizer.init(params)
    keys = jax.random.split(key, GRADIENT_STEPS)
    (params, _), _ = jax.jit(lambda c: jax.lax.scan(step, c, keys))(carry)
    *inputs, skill = test
    right = np.asarray(jax.jit(log_probs)(params, *inputs).argmax(-1) == skill)
    return float(np.mean([right[skill == z].mean() for z in np.unique(skill)]))


def measure(run: Path, seed: int) -> dict[str, Any]:
    """Return the accuracy for one seed."""
    trained = load_run(run, seed)
    check_skills(trained)
    config = trained.config.algorithm
    key_play, key_learn = jax.random.split(jax.random.key(0))
    played = collect(trained, key_play)

    def accuracy(length: int) -> float:
        segments = (cut(x, length) for x in played)
        return round(classify(*segments, config.ppo.hidden_size, key_learn), 3)

    return {
        "seed": seed, "env_steps": trained.env_steps, "chance": 1 / config.num_skills,
        "accuracy": accuracy(1), "segment_accuracy": accuracy(config.skill_interval),
    }  # fmt: skip


if __name__ == "__main__":
    record_seeds(__doc__, "folder of an HMASD run", measure)
