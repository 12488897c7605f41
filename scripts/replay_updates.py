"""Record which level of an HMASD team breaks in the updates after a checkpoint.

python scripts/replay_updates.py RUN OUT --seed 3 --step 1440000

The updates run again from the checkpoint, compiled as in training. OUT (JSON) gets one row per
update: the success of sampled play with both levels as they are then, with only the coordinator of
then and the discoverer of the checkpoint, and the other way round; and for each gradient step of
the coordinator its gradient's norm and the KL divergence before it. No parameters are averaged.
"""

from functools import partial
from pathlib import Path
from typing import Any

import jax

from hmasd_jax.hmasd import algorithm
from hmasd_jax.hmasd.batches import high_batch
from hmasd_jax.hmasd.coefficients import random_share
from hmasd_jax.hmasd.components import Parts, make_parts
from hmasd_jax.hmasd.policy import make_policy
from hmasd_jax.hmasd.rollout_phase import collect
from hmasd_jax.rl.evaluate import evaluate
from hmasd_jax.rl.sgd import ppo_step
from hmasd_jax.runs.load import load_run
from hmasd_jax.training.compiled import build_executable
from hmasd_jax.types import Learner
from scripts.records import checkpoint_parser, describe_script, write_rows

EPISODES = 200


def coordinator_steps(
    parts: Parts, state: algorithm.HMASDState
) -> tuple[Learner, dict[str, jax.Array]]:
    """Repeat the coordinator's training of one update, step by step.

    Returns:
        The trained coordinator, and the norm of the gradient and the KL divergence of every step.
    """
    ppo = parts.config.ppo
    _, key_collect, key_choose, key_high, *_ = jax.random.split(state.key, 6)
    params, norm = state.coordinator.params, state.coordinator_norm
    rollout = collect(
        parts, params, state.discoverer.params, state.env, state.memory, key_collect,
        random_share(parts, state.bonus),
    )  # fmt: skip
    batch = high_batch(parts, params, norm, rollout, key_choose)
    optimizer, loss_fn = algorithm.coordinator_objective(parts, state.bonus)

    def step(carry, order):
        minibatch = jax.tree.map(lambda x: x[order], batch)
        carry, metrics = ppo_step(optimizer, loss_fn, carry, minibatch)
        return carry, {name: metrics[name] for name in ("grad_norm", "approx_kl")}

    size = batch.target.shape[0]
    keys = jax.random.split(key_high, ppo.num_epochs)
    orders = jax.vmap(lambda key: jax.random.permutation(key, size))(keys)
    orders = orders.reshape(ppo.steps_per_update, -1)
    (learner, _), metrics = jax.lax.scan(step, (state.coordinator, norm), orders)
    return learner, metrics


def replay(run: Path, seed: int, step: int, num_updates: int) -> list[dict[str, Any]]:
    """Return one row per update after the checkpoint of a step."""
    trained = load_run(run, seed, step)
    parts = make_parts(trained.env, trained.config.algorithm)
    # Other compiler options round differently.
    update = build_executable(jax.jit(trained.algorithm.update), trained.state)
    steps = jax.jit(partial(coordinator_steps, parts))

    @jax.jit
    def success(coordinator, discoverer, key):
        policy = make_policy(parts, coordinator, discoverer, greedy=False)
        return evaluate(trained.env, policy, key, EPISODES)["success"]

    state, rows = trained.state, []
    for index in range(num_updates):
        _, metrics = steps(state)
        state, _ = update(state)
        new, old = state, trained.state
        levels = {
            "both": (new.coordinator.params, new.discoverer.params),
            "coordinator": (new.coordinator.params, old.discoverer.params),
            "discoverer": (old.coordinator.params, new.discoverer.params),
        }
        key = jax.random.key(index)
        shares = {name: float(success(*params, key)) for name, params in levels.items()}
        rows.append(
            {"update": index + 1}
            | {f"success_{name}": round(share, 3) for name, share in shares.items()}
            | {name: [float(f"{x:.3g}") for x in values] for name, values in metrics.items()}
        )
    return rows


def main() -> None:
    """Replay the updates that the command line asks for."""
    args = checkpoint_parser(__doc__, "folder of an HMASD run", updates=4).parse_args()
    about = describe_script(args.run)
    write_rows(args.out, about, replay(args.run, args.seed, args.step, args.updates))


if __name__ == "__main__":
    main()
