"""Measure environment steps per second against the number of copies.

python benchmarks/environments.py [--env alice_and_bob] [--copies 32 1024] [--json]

Random play on one core, compiled with JAX's own settings. Observations and resets are included, as
in training.
"""

from collections.abc import Callable
from typing import Any

import jax

import envs_jax
from benchmarks.measure import Row, isolated, jitted, measure, parser, peak_rss_mb, report
from envs_jax.registry import ENVIRONMENTS
from hmasd_jax.rl import rollout
from hmasd_jax.runs import folder as run_folder


def random_play(
    env: envs_jax.Environment, copies: int, steps: int
) -> tuple[Callable[[], Any], float, int]:
    """Compile random play in `copies` copies of `env` for `steps` steps.

    Returns:
        A call that plays, the seconds to compile it, and its number of environment steps.
    """

    def step(carry, key):
        key_action, key_env = jax.random.split(key)
        action = envs_jax.random_actions(key_action, carry.timestep.action_mask)
        carry, outcome = rollout.step(env, carry, action, key_env)
        # The carry holds observations and states, so that they are computed as in training.
        # Summing them up instead would take as long as the step itself in some environments.
        return carry, outcome.reward

    def play(carry, key):
        return jax.lax.scan(step, carry, jax.random.split(key, steps))

    key = jax.random.key(0)
    carry = rollout.reset(env, key, copies)
    program, compile_s = jitted(play, carry, key)
    return lambda: program(carry, key), compile_s, copies * steps


def bench(name: str, copies: int, steps: int, repeats: int) -> Row:
    """Measure random play in `copies` copies of the environment `name`."""
    call, compile_s, env_steps = random_play(envs_jax.make(name), copies, steps)
    timing = measure(call, repeats)
    return Row(
        name=f"{copies} copies",
        env=name,
        **timing.rates(env_steps),
        compile_s=compile_s,
        peak_rss_mb=peak_rss_mb(),
    )


def main() -> None:
    """Run the benchmark from the command line."""
    options = parser(__doc__)
    options.add_argument(
        "--env", default="alice_and_bob", choices=ENVIRONMENTS, help="default: %(default)s"
    )
    options.add_argument("--copies", type=int, nargs="+", default=[1, 8, 32, 128, 1024, 8192])
    args = options.parse_args()
    copies, env_steps = ([2], 20) if args.quick else (args.copies, 1_000_000)
    core = run_folder.available_cores()[0]
    rows = (
        isolated(bench, args.env, n, max(env_steps // n, 10), args.repeats, core=core)
        for n in copies
    )
    report(rows, args.json)


if __name__ == "__main__":
    main()
