"""Compare environments and training with JaxMARL, alternating in one process on one core.

python benchmarks/compare.py [--jaxmarl CHECKOUT] [--json]        (needs the extra `compare`)

Environments: random play in ours and in JaxMARL's version of the same game, with 32 and with 1024
copies, observations and resets included.

Training, with a checkout of JaxMARL (its package does not contain its trainers): one update of our
HMASD and of our MAPPO, with two agents on Alice_and_Bob and with three on 3m, against one update of
its MAPPO-RNN on SMAX 3m. All use 32 copies x 100 steps, 15 epochs, one minibatch, and width 64 for
hidden layers and GRU.
"""

import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import jax

import envs_jax
from benchmarks.environments import random_play
from benchmarks.measure import Row, alternate, compiled, isolated, jitted, parser, report
from benchmarks.training import preset
from hmasd_jax import config as configs
from hmasd_jax.runs import folder as run_folder

COPIES, STEPS = 32, 100
ALGORITHMS = ("hmasd", "mappo")
GAMES = ("alice_and_bob", "micro_battle")
SMAX = ("HeuristicEnemySMAX", {"scenario": "3m"})
PAIRS = [
    ("overcooked", {"layout": ours}, "overcooked", {"layout": theirs})
    for ours, theirs in (
        ("cramped_room", "cramped_room"),
        ("asymmetric_advantages", "asymm_advantages"),
        ("coordination_ring", "coord_ring"),
    )
]
PAIRS += [("micro_battle", {"scenario": "3m"}, *SMAX), ("alice_and_bob", {}, *SMAX)]
"""Our environment and options, and JaxMARL's; SMAX stands in for Alice_and_Bob, which it lacks."""
THEIR_TRAINER = Path("baselines/MAPPO/mappo_rnn_smax.py")
THEIR_SETTINGS = {
    "LR": 5e-4,
    "NUM_ENVS": COPIES,
    "NUM_STEPS": STEPS,
    "FC_DIM_SIZE": 64,
    "GRU_HIDDEN_DIM": 64,
    "UPDATE_EPOCHS": 15,
    "NUM_MINIBATCHES": 1,
    "GAMMA": 0.99,
    "GAE_LAMBDA": 0.95,
    "CLIP_EPS": 0.2,
    "SCALE_CLIP_EPS": False,
    "ENT_COEF": 0.01,
    "VF_COEF": 1.0,
    "MAX_GRAD_NORM": 10.0,
    "ACTIVATION": "relu",
    "OBS_WITH_AGENT_ID": True,
    "MAP_NAME": "3m",
    "ENV_KWARGS": {},
    "ANNEAL_LR": False,
    "SEED": 0,
}

Contender = tuple[Callable[[], Any], float, int]
"""A call, the seconds that it took to compile, and its number of environment steps."""


def race(contenders: dict[str, Contender], repeats: int) -> list[Row]:
    """Time all contenders in turn and return a row for each."""
    timings = alternate({name: call for name, (call, _, _) in contenders.items()}, repeats)
    return [
        Row(name, compile_s=compile_s, **timings[name].rates(env_steps))
        for name, (_, compile_s, env_steps) in contenders.items()
    ]


def bench_environments(pair: tuple, copies: int, env_steps: int, repeats: int) -> list[Row]:
    """Measure random play in ours and theirs."""
    name, options, their_name, their_options = pair
    steps = max(env_steps // copies, 10)
    titles = (" ".join([x, *map(str, o.values())]) for x, o in (pair[:2], pair[2:]))
    ours, theirs = (f"{title}, {copies} copies" for title in titles)
    return race(
        {
            ours: random_play(envs_jax.make(name, **options), copies, steps),
            f"JaxMARL {theirs}": _their_play(their_name, their_options, copies, steps),
        },
        repeats,
    )


def _their_play(name: str, options: dict[str, Any], copies: int, steps: int) -> Contender:
    words = ", ".join(f"{option}={value}" for option, value in options.items())
    env = envs_jax.make("jaxmarl", id=name, options=words).source
    spaces = [env.action_space(agent) for agent in env.agents]

    def one_step(key, state_and_obs):
        state, _ = state_and_obs
        key_action, key_step = jax.random.split(key)
        keys = jax.random.split(key_action, len(spaces))
        actions = {a: s.sample(k) for a, s, k in zip(env.agents, spaces, keys)}
        obs, state, reward, _, _ = env.step(key_step, state, actions)
        return (state, obs), reward

    def play(carry, key):
        def step(carry, key):
            return jax.vmap(one_step)(jax.random.split(key, copies), carry)

        return jax.lax.scan(step, carry, jax.random.split(key, steps))

    key = jax.random.key(0)
    obs, states = jax.vmap(env.reset)(jax.random.split(key, copies))
    program, compile_s = jitted(play, (states, obs), key)
    return lambda: program((states, obs), key), compile_s, copies * steps


def bench_training(
    games: Sequence[str], algorithms: Sequence[str], checkout: Path, quick: bool, repeats: int
) -> list[Row]:
    """Measure one update of each of ours, and of theirs."""
    contenders = {
        f"{algorithm} on {game}, one update": _our_training(game, algorithm, quick)
        for game in games
        for algorithm in algorithms
    }
    theirs = _their_training(checkout, updates=1 if quick else 5)
    return race(contenders | {"JaxMARL MAPPO-RNN on SMAX 3m": theirs}, repeats)


def _our_training(env: str, algorithm: str, quick: bool) -> Contender:
    """Compile one update at the paper's settings."""
    _, config = preset(env, algorithm, quick)
    _, learner = configs.build(config)
    state = jax.jit(learner.init)(jax.random.key(0))
    update, compile_s = compiled(learner.update, state)
    return lambda: update(state), compile_s, config.env_steps_per_update


def _their_training(checkout: Path, updates: int) -> Contender:
    """Compile their trainer for several updates, so that its initialization hardly counts."""
    source = (checkout / THEIR_TRAINER).read_text()
    width = THEIR_SETTINGS["GRU_HIDDEN_DIM"]
    fixed = 'initialize_carry(config["NUM_ACTORS"], 128)'  # this width ignores the settings
    if fixed not in source:
        raise SystemExit(
            f"{checkout / THEIR_TRAINER} does not contain {fixed!r}: check out JaxMARL at c793d09"
        )
    stubs = {
        "wandb": SimpleNamespace(log=lambda *args, **kwargs: None),
        "hydra": SimpleNamespace(main=lambda **_: lambda function: function),
        "omegaconf": SimpleNamespace(OmegaConf=None),
    }
    trainer = ModuleType("their_trainer")
    saved = {name: sys.modules.get(name) for name in stubs}
    sys.modules.update(stubs)  # needed only by its command line and its logging
    try:
        exec(source.replace(fixed, fixed.replace("128", str(width))), trainer.__dict__)
    finally:
        for name, module in saved.items():
            sys.modules.pop(name) if module is None else sys.modules.update({name: module})
    env_steps = updates * COPIES * STEPS
    train = trainer.make_train(THEIR_SETTINGS | {"TOTAL_TIMESTEPS": env_steps})
    program, compile_s = jitted(train, jax.random.PRNGKey(0))
    return lambda: program(jax.random.PRNGKey(0)), compile_s, env_steps


def main() -> None:
    """Run the benchmark from the command line."""
    options = parser(__doc__)
    options.add_argument("--jaxmarl", type=Path, help="a checkout of JaxMARL, to compare training")
    options.add_argument("--env", nargs="+", choices=GAMES, default=GAMES, help="ours to train on")
    options.add_argument("--algorithm", nargs="+", choices=ALGORITHMS, default=ALGORITHMS)
    args = options.parse_args()
    core = run_folder.available_cores()[0]
    env_steps = 20 if args.quick else 200_000
    rows = []
    for pair in PAIRS[:1] if args.quick else PAIRS:
        for copies in (2,) if args.quick else (32, 1024):
            rows += isolated(bench_environments, pair, copies, env_steps, args.repeats, core=core)
    if args.jaxmarl:
        work = args.env, args.algorithm, args.jaxmarl, args.quick, args.repeats
        rows += isolated(bench_training, *work, core=core)
    report(rows, args.json)


if __name__ == "__main__":
    main()
