"""Trace algorithms while every call is checked against its annotations of types and shapes."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
from beartype import BeartypeConf, beartype
from jaxtyping import install_import_hook

CHECKED = (
    "envs_jax", "hmasd_jax.baselines", "hmasd_jax.exploration", "hmasd_jax.hmasd",
    "hmasd_jax.networks", "hmasd_jax.rl",
)  # fmt: skip
"""Packages that arrays pass through."""
check = beartype(conf=BeartypeConf(is_pep484_tower=True))
"""Check of a call, in which an int is a float."""


def trace_all(presets: Sequence[str]) -> None:
    """Trace presets in a process that has not yet imported what is to be checked."""
    with install_import_hook(CHECKED, "tests.helpers.shapes.check"):
        for preset in presets:
            trace(preset)


def trace(preset: str) -> None:
    """Trace `init`, `update` and one step of the policy of a preset."""
    from hmasd_jax.config import build, load

    env, algorithm = build(load(f"configs/{preset}.toml"))

    def run(key: jax.Array) -> object:
        state, _ = algorithm.update(algorithm.init(key))
        policy = algorithm.policy(state)
        _, timesteps = jax.vmap(env.reset)(jax.random.split(key, 3))
        return policy.step(policy.init((3,)), timesteps, jnp.ones(3, bool), key)

    jax.eval_shape(run, jax.random.key(0))
