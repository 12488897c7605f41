"""Compare a gradient step of MASER with one of its authors' PyTorch code, in turn on one core.

python benchmarks/maser.py --python PYTHON --checkout MASER [--scenario 3m ...] [--json]

PYTHON is an interpreter with torch, and MASER a copy of Jiwonjeon9603/MASER. Both sides learn from
32 random episodes of full length with the sizes of the scenario's preset, the original with one
thread. Environment steps are those of one episode, as the original takes a gradient step after each
episode. Playing is not included. `ratio` is the work per CPU-second relative to the original.
"""

import json
import statistics
import subprocess
import time
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.measure import Row, compiled, parser, report
from hmasd_jax import config as configs
from hmasd_jax.analysis.statistics import estimate
from hmasd_jax.baselines.qmix.replay import Episodes, Seen
from hmasd_jax.rl.sgd import gradient_step
from hmasd_jax.runs import folder as run_folder
from hmasd_jax.training.workers import pin
from hmasd_jax.types import Learner

ROOT = Path(__file__).parents[1]
ROUNDS_PER_REPEAT = 4


def random_episodes(env, batch_size: int) -> Episodes:
    """Draw episodes of full length."""
    rng, steps = np.random.default_rng(0), (env.max_steps, batch_size)
    seen, agents = (env.max_steps + 1, batch_size), (env.num_agents,)
    normal = {
        "obs": rng.normal(size=(*seen, *agents, env.obs_dim)),
        "state": rng.normal(size=(*seen, env.state_dim)),
    }
    mask = jnp.ones((*seen, *agents, env.num_actions), bool)
    return Episodes(
        seen=Seen(**{k: jnp.asarray(x, jnp.float32) for k, x in normal.items()}, action_mask=mask),
        action=jnp.asarray(rng.integers(env.num_actions, size=(*steps, *agents)), jnp.int32),
        reward=jnp.asarray(rng.normal(size=steps), jnp.float32),
        terminated=jnp.zeros(steps, bool).at[-1].set(True),
        valid=jnp.ones(steps, bool),
    )


def ours(config: configs.TrainConfig) -> tuple[Callable[[], float], float]:
    """Compile a gradient step. Return a function of its CPU-seconds, and the seconds to compile."""
    env, algorithm = configs.build(config)
    parts = algorithm.update.args[0]  # pyrefly: ignore
    episodes = random_episodes(env, config.algorithm.q_learning.batch_size)
    first = jax.tree.map(lambda x: x[0], episodes.seen)
    params = parts.networks.init(jax.random.key(0), first)
    learner = Learner(params, parts.optimizer.init(params))

    def step(learner, target_params, episodes):
        return gradient_step(learner, parts.optimizer, parts.loss, target_params, episodes)

    program, compile_s = compiled(step, learner, params, episodes)

    def seconds() -> float:
        start = time.process_time()
        jax.block_until_ready(program(learner, params, episodes))
        return time.process_time() - start

    return seconds, compile_s


class Original:
    """Process that takes gradient steps with the authors' code."""

    def __init__(self, python: Path, checkout: Path, config: configs.TrainConfig) -> None:
        """Start the process."""
        env, algorithm = config.env, config.algorithm
        sizes = {
            "n_agents": env.num_agents, "n_actions": env.num_actions, "obs_shape": env.obs_dim,
            "state_shape": env.state_dim, "max_steps": env.max_steps,
            "batch_size": algorithm.q_learning.batch_size,
            "rnn_hidden_dim": algorithm.q_learning.hidden_size,
            "mixing_embed_dim": algorithm.mixing_size,
        }  # fmt: skip
        self.process = subprocess.Popen(
            [python, ROOT / "benchmarks" / "serve_maser.py", checkout, json.dumps(sizes)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def seconds(self) -> float:
        """Take a gradient step and return its CPU-seconds."""
        assert self.process.stdin
        assert self.process.stdout
        print(file=self.process.stdin, flush=True)
        line = self.process.stdout.readline()
        if not line:
            raise RuntimeError("the original cannot take a step: see its error message above")
        return float(line)


def bench(scenario: str, python: Path, checkout: Path, rounds: int) -> list[Row]:
    """Return a row for the original and one for ours."""
    config = configs.load(ROOT / f"configs/micro_battle/{scenario}/maser.toml")
    step, compile_s = ours(config)
    original = Original(python, checkout, config)
    with original.process:
        sides = {"original": original.seconds, "hmasd_jax": step}
        for side in sides.values():
            side()  # the first one does not count
        clocks = {name: [] for name in sides}
        for number in range(rounds):
            for name in list(sides) if number % 2 else reversed(list(sides)):
                clocks[name].append(sides[name]())
        assert original.process.stdin
        original.process.stdin.close()
    ratios = np.array(clocks["original"]) / np.array(clocks["hmasd_jax"])
    ratio = estimate([ratios], lambda groups: np.median(groups[0]))
    medians = {name: statistics.median(seconds) for name, seconds in clocks.items()}
    rows = [
        Row(
            name,
            env=f"micro_battle {scenario}",
            algorithm="maser",
            env_steps_per_cpu_s=config.env.max_steps / medians[name],
            spread=(max(seconds) - min(seconds)) / medians[name],
            ratio=1.0 if name == "original" else ratio.value,
            ratio_interval=None if name == "original" else (ratio.low, ratio.high),
            compile_s=None if name == "original" else compile_s,
        )
        for name, seconds in clocks.items()
    ]
    return rows


def main() -> None:
    """Run the benchmark from the command line."""
    options = parser(__doc__)
    options.add_argument("--python", type=Path, required=True, help="interpreter with torch")
    options.add_argument("--checkout", type=Path, required=True, help="the original repository")
    options.add_argument("--scenario", nargs="+", default=["3m"], help="default: 3m")
    args = options.parse_args()
    pin(run_folder.available_cores()[0])
    rounds = args.repeats * (1 if args.quick else ROUNDS_PER_REPEAT)
    rows = []
    for scenario in args.scenario:
        rows += bench(scenario, args.python, args.checkout, rounds)
    report(rows, args.json)


if __name__ == "__main__":
    main()
