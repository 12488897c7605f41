"""Measure time and memory of one update of HMASD as copies, agents and the rollout grow.

python benchmarks/growth.py [--minibatches 16] [--out results/benchmarks/growth.png] [--json]

Runs on one core. All sizes but the one that grows are those of the paper's Alice_and_Bob.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import jax
import jax.numpy as jnp

from benchmarks.measure import Row, compiled, isolated, measure, parser, peak_rss_mb, report
from envs_jax.types import TimeStep
from hmasd_jax.hmasd import HMASDConfig, make_hmasd
from hmasd_jax.rl.ppo import PPOConfig
from hmasd_jax.runs import folder as run_folder

SIZES = {
    "num_envs": (8, 16, 32, 64, 128, 256, 512),
    "num_agents": (2, 4, 8, 16),
    "rollout_length": (50, 100, 200, 400, 800),
}
QUICK = {"num_agents": (3,)}
BASE = {"num_envs": 32, "num_agents": 2, "rollout_length": 100}


@dataclass(frozen=True)
class Noise:
    """Environment of random numbers for any number of agents, in the sizes of Alice_and_Bob."""

    num_agents: int
    num_actions: ClassVar[int] = 5
    obs_dim: ClassVar[int] = 11
    state_dim: ClassVar[int] = 100
    max_steps: ClassVar[int] = 100

    def reset(self, key: jax.Array) -> tuple[jax.Array, TimeStep]:
        """Start an episode; the simulator's state is the number of steps taken."""
        return jnp.int32(0), self._timestep(key, jnp.int32(0))

    def step(self, key: jax.Array, state: jax.Array, action: jax.Array):
        """Take a step, whatever the action."""
        return state + 1, self._timestep(key, state + 1)

    def _timestep(self, key: jax.Array, time: jax.Array) -> TimeStep:
        key_obs, key_state, key_reward = jax.random.split(key, 3)
        return TimeStep(
            obs=jax.random.normal(key_obs, (self.num_agents, self.obs_dim)),
            state=jax.random.normal(key_state, (self.state_dim,)),
            action_mask=jnp.ones((self.num_agents, self.num_actions), bool),
            reward=jax.random.normal(key_reward),
            terminated=time == self.max_steps,
            truncated=jnp.bool_(False),
            info={},
        )


def bench(what: str, size: int, minibatches: int, quick: bool, repeats: int) -> Row:
    """Measure one update with `what` at `size`, and all else as in `BASE`."""
    sizes = BASE | ({"num_envs": 1, "rollout_length": 50} if quick else {}) | {what: size}
    env = Noise(sizes["num_agents"])
    ppo = PPOConfig(
        num_envs=sizes["num_envs"],
        rollout_length=sizes["rollout_length"],
        num_minibatches=minibatches,
    )
    algorithm = make_hmasd(env, HMASDConfig(ppo=ppo))
    state = jax.jit(algorithm.init)(jax.random.key(0))
    update, compile_s = compiled(algorithm.update, state)
    timing = measure(lambda: update(state), repeats)
    env_steps = ppo.num_envs * ppo.rollout_length
    return Row(
        f"{what} {size}",
        algorithm="hmasd",
        **timing.rates(env_steps),
        compile_s=compile_s,
        peak_rss_mb=peak_rss_mb(),
    )


def draw(rows: list[Row], out: Path) -> None:
    """Plot seconds per update and memory against each size, with a dotted line in proportion."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(2, len(SIZES), figsize=(11, 6), sharex="col", sharey="row")
    for column, what in enumerate(SIZES):
        mine = [(int(r.name.split()[1]), r) for r in rows if r.name.startswith(what)]
        sizes = [size for size, _ in mine]
        seconds = [_env_steps(what, size) / row.env_steps_per_cpu_s for size, row in mine]
        for axis, values, unit in (
            (axes[0, column], seconds, "CPU seconds per update"),
            (axes[1, column], [row.peak_rss_mb for _, row in mine], "peak memory, MB"),
        ):
            axis.loglog(sizes, values, "o-")
            axis.loglog(sizes, [values[-1] * size / sizes[-1] for size in sizes], ":", color="gray")
            axis.grid(alpha=0.3)
            if column == 0:
                axis.set_ylabel(unit)
        axes[1, column].set_xlabel(what)
        axes[1, column].set_xticks(sizes, [str(size) for size in sizes])
        axes[1, column].minorticks_off()
    figure.tight_layout()
    out.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(out, dpi=120)


def _env_steps(what: str, size: int) -> int:
    sizes: dict[str, Any] = BASE | {what: size}
    return sizes["num_envs"] * sizes["rollout_length"]


def main() -> None:
    """Run the benchmark from the command line."""
    options = parser(__doc__)
    options.add_argument("--minibatches", type=int, default=1, help="of PPO (default: 1)")
    options.add_argument("--out", type=Path, help="PNG to draw")
    args = options.parse_args()
    core = run_folder.available_cores()[0]
    rows = [
        isolated(bench, what, size, args.minibatches, args.quick, args.repeats, core=core)
        for what, sizes in (QUICK if args.quick else SIZES).items()
        for size in sizes
    ]
    report(rows, args.json)
    if args.out:
        draw(rows, args.out)


if __name__ == "__main__":
    main()
