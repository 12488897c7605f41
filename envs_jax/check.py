"""Check that an environment conforms to `types.Environment`. Use it for your own environments."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int

from envs_jax.declared import count_events, locate_agents, name_actions
from envs_jax.types import Environment, EnvState, TimeStep

NUM_EPISODES = 16
SIZES = ("num_agents", "num_actions", "obs_dim", "state_dim", "max_steps")
METHODS = ("reset", "step", "render")
TAKEN = {"kind", "seed", "env_steps", "wall_seconds", "return", "length", "episodes"}
"""Names that records of training and evaluation have themselves."""


class EnvironmentCheckError(AssertionError):
    """An environment violates the `Environment` protocol."""


def check_environment(
    env: Environment, key: jax.Array | None = None, num_steps: int | None = None
) -> None:
    """Check that an environment conforms to `Environment` and `TimeStep`, by random legal actions.

    Args:
        env: Environment to check.
        key: Random key of the episodes played; by default always the same one.
        num_steps: Steps to play in each of 16 episodes; by default `env.max_steps`. With fewer
            steps the time limit is not checked.

    Raises:
        EnvironmentCheckError: A requirement is not met. The message names the first such
            requirement and what was found instead.
    """
    key_types, key_transforms, key_play, key_render = jax.random.split(
        jax.random.key(0) if key is None else key, 4
    )
    _check_attributes(env)
    _check_types(env, key_types)
    _check_transforms(env, key_transforms)
    _check_episodes(env, key_play, env.max_steps if num_steps is None else num_steps)
    _check_render(env, key_render)
    _check_declarations(env, key_render)


def _require(met: Any, env: Environment, requirement: str, found: Any) -> None:
    if not met:
        raise EnvironmentCheckError(f"{type(env).__name__}: {requirement}; found {found}")


def _check_attributes(env: Environment) -> None:
    """Check for positive int sizes, for the methods, and for a frozen, hashable dataclass."""
    for name in SIZES:
        size = getattr(env, name, None)
        _require(type(size) is int and size > 0, env, f"{name} must be an int above 0", repr(size))
    for name in METHODS:
        method = getattr(env, name, None)
        _require(callable(method), env, f"it must have a method {name}", repr(method))
    params = getattr(env, "__dataclass_params__", None)
    frozen = params is not None and params.frozen
    kind = "a dataclass that is not frozen" if params is not None else "no dataclass"
    _require(frozen, env, "it must be a frozen dataclass", kind)
    try:
        hash(env)
    except TypeError as error:
        requirement = "it must be hashable, so its fields must not hold arrays, lists or dicts"
        _require(False, env, requirement, error)


def _check_types(env: Environment, key: jax.Array) -> None:
    """Check that shapes and dtypes are right, and equal at `reset` and after every `step`.

    It follows that `step` compiles once and can run inside `jax.lax.scan`.
    """
    action = jax.ShapeDtypeStruct((env.num_agents,), jnp.int32)
    at_reset = _output_types(env, "reset", env.reset, key)
    at_step = _output_types(env, "step", env.step, key, at_reset[0], action)
    for name, (_, timestep) in (("reset", at_reset), ("step", at_step)):
        _check_timestep_types(env, name, timestep)
    keys_at_reset, keys_at_step = sorted(at_reset[1].info), sorted(at_step[1].info)
    requirement = f"info must have the same keys after a step as at reset, {keys_at_reset}"
    _require(keys_at_reset == keys_at_step, env, requirement, keys_at_step)
    structures = [jax.tree.structure(output[0]) for output in (at_reset, at_step)]
    requirement = f"step must keep the structure of env_state, {structures[0]}"
    _require(structures[0] == structures[1], env, requirement, structures[1])

    named = [_by_path(*output) for output in (at_reset, at_step)]
    for path, before in named[0].items():
        after = named[1][path]
        for name, leaf in (("reset", before), ("step", after)):
            requirement = (
                f"{path} of {name} must have a fixed dtype (write jnp.float32(0) instead of a "
                "Python number)"
            )
            _require(not leaf.weak_type, env, requirement, _describe(leaf))
        requirement = f"{path} of step must have the dtype and shape of reset, {_describe(before)}"
        _require(_describe(before) == _describe(after), env, requirement, _describe(after))


def _output_types(
    env: Environment, name: str, function: Callable, *args: Any
) -> tuple[EnvState, TimeStep]:
    """Trace `function` and return the shapes and dtypes of its output."""
    try:
        output = jax.eval_shape(function, *args)
    except (TypeError, IndexError) as error:  # Base classes of JAX's tracing errors.
        reason = str(error).strip().split("\n")[0]
        raise EnvironmentCheckError(
            f"{type(env).__name__}: {name} must run under jax.jit; found {reason}"
        ) from error
    is_pair = isinstance(output, tuple) and len(output) == 2 and isinstance(output[1], TimeStep)
    found = getattr(output, "_fields", None) or type(output).__name__
    _require(is_pair, env, f"{name} must return (env_state, TimeStep)", found)
    return output


def _check_timestep_types(env: Environment, name: str, timestep: TimeStep) -> None:
    """Check shapes and dtypes of a `TimeStep`."""
    agents = env.num_agents
    expected = {
        "obs": jax.ShapeDtypeStruct((agents, env.obs_dim), jnp.float32),
        "state": jax.ShapeDtypeStruct((env.state_dim,), jnp.float32),
        "action_mask": jax.ShapeDtypeStruct((agents, env.num_actions), jnp.bool),
        "reward": jax.ShapeDtypeStruct((), jnp.float32),
        "terminated": jax.ShapeDtypeStruct((), jnp.bool),
        "truncated": jax.ShapeDtypeStruct((), jnp.bool),
    }
    for field, leaf in expected.items():
        found = _describe(getattr(timestep, field))
        requirement = f"{field} of {name} must be {_describe(leaf)}"
        _require(found.removesuffix(" (weak)") == _describe(leaf), env, requirement, found)
    info = timestep.info
    is_dict = isinstance(info, dict) and all(isinstance(name, str) for name in info)
    _require(is_dict, env, f"info of {name} must be a dict with strings as keys", info)
    taken = sorted(TAKEN & info.keys())
    requirement = f"info of {name} must not have {', '.join(sorted(TAKEN))}, which records have"
    _require(not taken, env, requirement, taken)
    for field, leaf in info.items():
        is_scalar = getattr(leaf, "shape", None) == ()
        _require(is_scalar, env, f"info[{field!r}] of {name} must be a scalar", _describe(leaf))


def _describe(leaf: Any) -> str:
    if not isinstance(leaf, jax.ShapeDtypeStruct):
        return type(leaf).__name__
    return f"{leaf.dtype} {leaf.shape}" + " (weak)" * leaf.weak_type


def _by_path(env_state: EnvState, timestep: TimeStep) -> dict[str, Any]:
    """Return the leaves by path, e.g. "timestep.info['success']"."""
    tree = {"env_state": env_state, "timestep": timestep}
    leaves = jax.tree_util.tree_leaves_with_path(tree)
    return {path[0].key + jax.tree_util.keystr(path[1:]): leaf for path, leaf in leaves}


def _check_transforms(env: Environment, key: jax.Array) -> None:
    """Check that equal keys give equal results, and that `jit` and `vmap` do not change them."""

    def first_step(key: jax.Array) -> dict[str, tuple[EnvState, TimeStep]]:
        key_reset, key_action, key_step = jax.random.split(key, 3)
        env_state, timestep = env.reset(key_reset)
        action = _random_action(key_action, timestep.action_mask)
        return {"reset": (env_state, timestep), "step": env.step(key_step, env_state, action)}

    keys = jax.random.split(key, 2)
    single = [first_step(key) for key in keys]
    batched = jax.jit(jax.vmap(first_step))(keys)
    requirement = "a second call with the same key must return the same as the first"
    _require_equal(env, requirement, single[0], first_step(keys[0]))
    _require_equal(
        env, "jax.jit must not change the result", single[0], jax.jit(first_step)(keys[0])
    )
    for copy in range(2):
        one_of_batch = jax.tree.map(lambda x, copy=copy: x[copy], batched)
        requirement = "jax.vmap must return the same as single calls"
        _require_equal(env, requirement, single[copy], one_of_batch)


def _require_equal(env: Environment, requirement: str, expected: dict, got: dict) -> None:
    """Compare outputs of `reset` and `step` up to rounding."""
    for name, output in expected.items():
        got_leaves = _by_path(*got[name])
        for path, leaf in _by_path(*output).items():
            a, b = _to_numpy(leaf), _to_numpy(got_leaves[path])
            same = np.allclose(a, b, rtol=1e-4, atol=1e-5, equal_nan=True)
            _require(same, env, f"{requirement}: {path} of {name} is {a.tolist()}", b.tolist())


def _to_numpy(leaf: Any) -> np.ndarray:
    is_key = isinstance(leaf, jax.Array) and jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)
    return np.asarray(jax.random.key_data(leaf) if is_key else leaf)


def _random_action(key: jax.Array, mask: Bool[Array, "agents actions"]) -> Int[Array, " agents"]:
    return jax.random.categorical(key, jnp.where(mask, 0.0, -jnp.inf))


def _check_episodes(env: Environment, key: jax.Array, num_steps: int) -> None:
    """Check what must hold at every step of an episode, and that episodes end in time."""
    start, steps = jax.tree.map(
        np.asarray, jax.jit(_play, static_argnums=(0, 2))(env, key, num_steps)
    )
    for field in ("reward", "terminated", "truncated"):
        value = getattr(start, field)
        _require(not value.any(), env, f"{field} must be 0 or False at reset", value.max())

    # Time 0 is the reset.
    timesteps = jax.tree.map(lambda a, b: np.concatenate([a[None], b]), start, steps)
    done = timesteps.terminated | timesteps.truncated
    # (time, episodes): True up to and including the last step of each episode.
    inside = np.cumsum(done, axis=0) - done == 0

    def always(holds: np.ndarray, requirement: str, found: str) -> None:
        broken = inside & ~holds.reshape(*inside.shape, -1).all(-1)
        time = broken.any(1).argmax()
        _require(not broken.any(), env, requirement, f"{found} at step {time} of an episode")

    always(timesteps.action_mask.any(-1), "each agent must always have a legal action", "none")
    never_both = ~(timesteps.terminated & timesteps.truncated)
    always(never_both, "terminated and truncated must not be true together", "both")
    for path, leaf in _by_path((), timesteps).items():
        always(np.isfinite(leaf), f"{path} must be finite", "nan or infinity")
    if num_steps >= env.max_steps:
        late = ~done[: env.max_steps + 1].any(0)
        requirement = f"every episode must end (terminated or truncated) by step {env.max_steps}"
        _require(not late.any(), env, requirement, f"{late.sum()} of {NUM_EPISODES} that went on")


def _play(env: Environment, key: jax.Array, num_steps: int) -> tuple[TimeStep, TimeStep]:
    """Play `NUM_EPISODES` random episodes.

    Returns:
        Time steps at reset, (episodes, ...), and after it, (num_steps, episodes, ...).
    """
    key_reset, key_play = jax.random.split(key)
    env_state, start = jax.vmap(env.reset)(jax.random.split(key_reset, NUM_EPISODES))

    def step(carry, key):
        env_state, action_mask = carry
        keys = jax.random.split(key, (2, NUM_EPISODES))
        action = jax.vmap(_random_action)(keys[0], action_mask)
        env_state, timestep = jax.vmap(env.step)(keys[1], env_state, action)
        return (env_state, timestep.action_mask), timestep

    carry = (env_state, start.action_mask)
    _, steps = jax.lax.scan(step, carry, jax.random.split(key_play, num_steps))
    return start, steps


def _check_render(env: Environment, key: jax.Array) -> None:
    """Check that `render` draws an unbatched state as a color image."""
    image = env.render(env.reset(key)[0])
    is_image = isinstance(image, np.ndarray) and image.dtype == np.uint8
    is_image = is_image and image.ndim == 3 and image.shape[-1] == 3 and image.size > 0
    found = type(image).__name__
    if isinstance(image, np.ndarray):
        found = f"{image.dtype} {image.shape}"
    _require(is_image, env, "render must return a NumPy uint8 image (height, width, 3)", found)


def _check_declarations(env: Environment, key: jax.Array) -> None:
    """Check the names, events and places that the environment declares, if any."""
    agents = env.num_agents
    for field, parts in (("agent_names", "names"), ("agent_colors", "colors")):
        found = getattr(env, field, range(agents))
        _require(len(found) == agents, env, f"{field} must have {agents} {parts}", found)
    names = name_actions(env)
    requirement = f"action_names must have {env.num_actions} names"
    _require(len(names) == env.num_actions, env, requirement, names)

    def first_step(key: jax.Array) -> tuple[dict[str, Array], Array | None]:
        env_state, timestep = env.reset(key)
        action = _random_action(key, timestep.action_mask)
        after, _ = env.step(key, env_state, action)
        return count_events(env, env_state, action, after), locate_agents(env, after)

    counts, places = jax.eval_shape(first_step, key)
    for name, count in counts.items():
        requirement = f"events must count {name!r} by agent, with shape ({agents},)"
        _require(count.shape == (agents,), env, requirement, count.shape)
    if places is not None:
        requirement = f"locate must return x and y by agent, with shape ({agents}, 2)"
        _require(places.shape == (agents, 2), env, requirement, places.shape)
