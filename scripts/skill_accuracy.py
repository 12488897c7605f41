"""Record how well the individual skills of trained runs can be told from what agents do.

python scripts/skill_accuracy.py RUN OUT

All agents hold one skill for whole episodes, and sample their actions. A new classifier of the form
of q_d learns which skill it was from the observations of half of the episodes. OUT (JSON) gets one
row per seed: the share of the steps of the other half at which it is right. Skills are held equally
often, so chance is 1 / n_z. The accuracy of q_d in training is higher where the coordinator prefers
a skill.
"""

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import optax

from hmasd_jax.analysis.episodes import play
from hmasd_jax.analysis.skills import Condition, allowed_skills
from hmasd_jax.hmasd.discriminators import Classifier
from hmasd_jax.rl import moments
from hmasd_jax.runs.load import TrainedRun, load_run
from scripts.records import record_seeds

EPISODES = 64
"""Episodes per skill."""
GRADIENT_STEPS = 2000
BATCH = 512
CLIP = 5.0
"""Bound of standardized features."""


def collect(trained: TrainedRun, key: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Play with each skill in turn.

    Returns:
        Observations (n, episodes, T * N, obs), whether they count, and the skills held (n,).
    """
    env, config = trained.env, trained.config.algorithm
    counts = config.num_team_skills, config.num_skills

    @jax.jit
    def hold(allowed, keys):
        policy = trained.algorithm.policy(trained.state, False, allowed=allowed)
        played = play(env, policy, keys)
        obs = played.timesteps.obs[:, 1:]
        counted = jnp.broadcast_to(played.counted[..., None], obs.shape[:-1])
        return obs.reshape(len(keys), -1, env.obs_dim), counted.reshape(len(keys), -1)

    skills = jnp.arange(config.num_skills)
    held = [Condition("held", "individual", z) for z in range(config.num_skills)]
    allowed = [jnp.asarray(allowed_skills(z, *counts, env.num_agents)) for z in held]
    keys = jax.random.split(key, (len(held), EPISODES))
    obs, counted = zip(*(hold(*x) for x in zip(allowed, keys)))
    return jnp.stack(obs), jnp.stack(counted), skills


def classify(
    obs: jax.Array, counted: jax.Array, skills: jax.Array, hidden_size: int, key: jax.Array
) -> float:
    """Train on the first half of the episodes, and return the accuracy on the other half."""
    half = obs.shape[1] // 2
    labels = jnp.broadcast_to(skills[:, None, None], counted.shape)

    def select(episodes: slice) -> tuple[jax.Array, jax.Array]:
        """Return the steps that count, and their skills."""
        counts = counted[:, episodes]
        return obs[:, episodes][counts], labels[:, episodes][counts]

    (train_x, train_y), (test_x, test_y) = select(slice(half)), select(slice(half, None))
    scale = moments.update(moments.Moments.create(obs.shape[-1]), train_x)
    network = Classifier(len(skills), hidden_size)
    key, key_init = jax.random.split(key)
    params = network.init(key_init, train_x[:1])
    optimizer = optax.adam(1e-3)

    def log_probs(params, x):
        return jnp.asarray(network.apply(params, moments.standardize(scale, x, CLIP)))

    def loss_fn(params, x, y):
        return -jnp.take_along_axis(log_probs(params, x), y[:, None], 1).mean()

    def step(carry, key):
        params, opt_state = carry
        pick = jax.random.randint(key, (BATCH,), 0, len(train_y))
        gradient = jax.grad(loss_fn)(params, train_x[pick], train_y[pick])
        updates, opt_state = optimizer.update(gradient, opt_state)
        return (optax.apply_updates(params, updates), opt_state), None

    carry = params, optimizer.init(params)
    keys = jax.random.split(key, GRADIENT_STEPS)
    (params, _), _ = jax.jit(lambda c: jax.lax.scan(step, c, keys))(carry)
    right = log_probs(params, test_x).argmax(-1) == test_y
    return float(right.mean())


def measure(run: Path, seed: int) -> dict[str, Any]:
    """Return the accuracy for one seed."""
    trained = load_run(run, seed)
    key_play, key_learn = jax.random.split(jax.random.key(0))
    hidden_size = trained.config.algorithm.ppo.hidden_size
    accuracy = classify(*collect(trained, key_play), hidden_size, key_learn)
    chance = 1 / trained.config.algorithm.num_skills
    return {
        "seed": seed, "env_steps": trained.env_steps, "accuracy": round(accuracy, 3),
        "chance": chance,
    }  # fmt: skip


if __name__ == "__main__":
    record_seeds(__doc__, "folder of an HMASD run", measure)
