"""Record results of the original code of EITI and EDTI, for the tests to compare with.

python tests/golden/record_eiti.py CHECKOUT    (of TonghanWang/EITI-EDTI)

Needs NumPy 2.4.6. Two agents walk at random on a small grid, so that transitions repeat, and an
agent is pushed by the other when they meet. The original counts, computes bonuses, mixes rewards
and computes returns; networks are replaced by random values. No episode ends: where one does, the
original uses the end of the first copy for all, and values of the next episode.
"""

import argparse
import sys
import tempfile
from pathlib import Path
from types import ModuleType, SimpleNamespace
from unittest.mock import MagicMock

import numpy as np

T, E, N, SIZE, ACTIONS = 60, 3, 2, 3, 4
DISCOUNT, GAE_LAMBDA = 0.9, 0.8
MOVES = np.array([(1, 0), (-1, 0), (0, 1), (0, -1)])
STUBS = ("tensorflow", "tensorflow_probability", "matplotlib", "matplotlib.pyplot", "cloudpickle",
         "baselines.proportional", "baselines.data_gather", "baselines.common.runners",
         "baselines.common.vec_env.vec_env")  # fmt: skip


def import_original(checkout: Path) -> tuple[type, type]:
    """Return their environment copies, which count, and their runner, without TensorFlow."""
    for name in STUBS:
        sys.modules[name] = MagicMock()
    for name in ("baselines", "baselines.common", "baselines.common.vec_env", "baselines.ppo2"):
        module = ModuleType(name)
        module.__path__ = [str(checkout.joinpath(*name.split(".")))]
        sys.modules[name] = module
    sys.modules["baselines.common.vec_env.vec_env"].VecEnv = object
    np.bool = bool  # NumPy 1.2 had this name
    from baselines.common.vec_env.subproc_vec_env import SubprocVecEnv_Pass
    from baselines.ppo2.runner import Runner

    return SubprocVecEnv_Pass, Runner


def settings(method: str) -> SimpleNamespace:
    """Return their options. `r_tv` is EDTI, `t` is EITI."""
    coefs = {
        "gamma_dec": 3.0, "gamma_cen": 0.0, "penalty": 0.0, "gamma_coor_t": 0.0,
        "gamma_coor_r": 1.0, "gamma_coor_r_e": 0.3, "gamma_coor_r_c": 0.2,
        "gamma_coor_tv": 1.0, "gamma_coor_tv_e": 0.1, "gamma_coor_tv_c": 0.7,
        "gamma_coor_v": 0.0, "gamma_coor_v_e": 0.0, "gamma_coor_v_c": 0.0,
    }  # fmt: skip
    if method == "eiti":
        coefs |= {"gamma_coor_t": 0.5}
    return SimpleNamespace(
        **coefs, n_agent=N, size=SIZE, n_action=ACTIONS, env_n_dim=2, env="pass", num_env=E,
        s_data_gather=True, s_alg_name="", symmetry=False, t_save_rate=1,
        save_path=tempfile.mkdtemp() + "/",
        t=method == "eiti", tv=False, r=False, v=False, r_tv=method == "edti",
    )  # fmt: skip


def walk(place: np.ndarray, action: np.ndarray, slips: np.ndarray) -> np.ndarray:
    """Move both agents (2, 2), unless they slip; agent 1 stays if agent 0 moves onto its cell."""
    after = np.clip(place + MOVES[action] * ~slips[:, None], 0, SIZE - 1)
    if (after[0] == place[1]).all():
        after[1] = place[1]
    return after


class Model:
    """Stand-in for the networks of an agent: random actions and values."""

    initial_state = e_initial_state = c_initial_state = None

    def __init__(self, rng: np.random.Generator, agent: int):
        self.action = rng.integers(ACTIONS, size=(T, E))
        self.values = rng.normal(size=(3, T + 1, E)).astype(np.float32)
        self.agent, self.time = agent, [0, 0, 0]

    def _next(self, stream: int, action: np.ndarray | None = None):
        time, self.time[stream] = self.time[stream], self.time[stream] + 1
        action = self.action[time] if stream == 0 else None
        return action, self.values[stream, time], None, np.zeros(E)

    def step(self, obs, S, M):  # noqa: N803
        return self._next(0)

    def e_step(self, obs, S, M):  # noqa: N803
        return self._next(1)

    def c_step(self, obs, S, M):  # noqa: N803
        return self._next(2)

    def value(self, obs, S, M):  # noqa: N803
        return self.values[0, T]

    def e_value(self, obs, S, M):  # noqa: N803
        return self.values[1, T]

    def c_value(self, obs, S, M):  # noqa: N803
        return self.values[2, T]


def make_copies(base: type, args: SimpleNamespace, rng: np.random.Generator, rewards: np.ndarray):
    """Build their environment copies around our walk."""
    places = [rng.integers(SIZE, size=(N, 2)) for _ in range(E)]
    visited = [np.stack(places)]

    class Copies(base):
        num_envs = E
        spec = N
        observation_space = SimpleNamespace(shape=(2,))

        def __init__(self):
            modules = sys.modules[base.__module__]
            self.args, self.ext_rewards, self.e_step = args, [], 0
            self.dec = modules.Dec(SIZE, N, args)
            self.cen = modules.Cen(SIZE, N, args)
            self.key_points = modules.Appro_C_points(SIZE, ACTIONS, args, is_print=True)
            self.pre_state_n = [None] * E

        def __del__(self):
            pass

        def reset(self):
            return np.zeros((N, E, 2))

        def step_async(self, actions):
            self.actions = actions

        def step_wait(self):
            slips = rng.random((E, N)) < 0.2
            after = np.stack([walk(*x) for x in zip(visited[-1], self.actions, slips)])
            infos = [{"state": [*place.copy()], "door": False} for place in after]
            reward = np.repeat(rewards[len(visited) - 1][:, None], N, axis=1)
            visited.append(after)
            return np.zeros((E, N, 2)), reward, np.zeros(E, bool), infos

    return Copies(), visited


def record(checkout: Path, method: str) -> dict[str, np.ndarray]:
    """Record a rollout of their runner."""
    copies_type, runner_type = import_original(checkout)
    rng = np.random.default_rng(0)
    args, models = settings(method), [Model(rng, agent) for agent in range(N)]
    rewards = rng.normal(size=(T, E)).astype(np.float32)
    copies, visited = make_copies(copies_type, args, rng, rewards)
    gathered = {}
    runner = runner_type(env=copies, model_n=models, nsteps=T, gamma=DISCOUNT, lam=GAE_LAMBDA)
    runner.data_gather.update = lambda data: gathered.update(all=data)
    outputs = runner.run()
    # Their rollouts are flattened (E T,) per agent: returns of the reward and of both streams.
    returns = [np.stack([x.reshape(E, T).T for x in outputs[k]], axis=-1) for k in (1, 6, 9)]
    data = gathered["all"]
    return {
        "place": np.stack(visited),  # (T + 1, E, N, 2)
        "action": np.stack([m.action for m in models], axis=-1),
        "team_reward": rewards,
        "value": np.stack([m.values.transpose(1, 2, 0) for m in models], axis=2),  # (T+1, E, N, 3)
        "reward": np.stack(data[4]).transpose(0, 2, 1),
        "curiosity": np.stack(data[6]).transpose(0, 2, 1),
        "influence": np.stack(data[7]).transpose(0, 2, 1),
        "target": np.stack(returns, axis=-1),
    }


def main() -> None:
    """Write the table of both algorithms next to this file."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("checkout", type=Path)
    checkout = parser.parse_args().checkout
    folder = Path(__file__).parent / "eiti"
    folder.mkdir(exist_ok=True)
    for method in ("eiti", "edti"):
        table = record(checkout, method)
        table = {k: x.astype(np.float32) if x.dtype == np.float64 else x for k, x in table.items()}
        np.savez_compressed(folder / f"{method}.npz", **table)


if __name__ == "__main__":
    main()
