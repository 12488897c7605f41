"""Take one gradient step of the original MASER for every line of standard input.

PYTHON benchmarks/serve_maser.py CHECKOUT SIZES

CHECKOUT is a copy of Jiwonjeon9603/MASER, and PYTHON has torch. SIZES is a JSON object with the
numbers that `benchmarks/maser.py` sends. The answer to a line is the step's CPU-seconds, with one
thread and random episodes of full length. This file imports nothing of this project.
"""

import importlib
import json
import sys
import time
from types import SimpleNamespace
from typing import Any

import torch

SETTINGS = {
    "device": "cpu", "agent": "rnn", "agent_output_type": "q", "obs_last_action": True,
    "obs_agent_id": True, "double_q": True, "gamma": 0.99, "lr": 5e-4, "optim_alpha": 0.99,
    "optim_eps": 1e-5, "grad_norm_clip": 10, "action_selector": "epsilon_greedy",
    "epsilon_start": 1.0, "epsilon_finish": 0.05, "epsilon_anneal_time": 50_000,
    "target_update_interval": 200, "learner_log_interval": 10**9, "lam": 0.03, "alpha": 0.5,
    "ind": 0.8, "mix": 0.2, "expl": 0.3, "dis": 0.7, "mixer": "qmix", "goal": "maser",
}  # fmt: skip


def make_batch(sizes: dict[str, int], scheme: dict[str, Any]) -> Any:
    """Fill their batch of episodes with random numbers."""
    module = importlib.import_module("components.episode_buffer")
    episodes, steps = sizes["batch_size"], sizes["max_steps"] + 1
    batch = module.EpisodeBatch(dict(scheme), {"agents": sizes["n_agents"]}, episodes, steps)
    data = batch.data.transition_data
    for name in ("obs", "state", "reward"):
        data[name].normal_()
    data["avail_actions"].fill_(1)
    data["filled"].fill_(1)
    data["terminated"][:, -2] = 1
    data["actions"].random_(0, sizes["n_actions"])
    data["actions_onehot"].scatter_(-1, data["actions"], 1)
    return batch


def main() -> None:
    """Serve until standard input ends."""
    sys.path.insert(0, sys.argv[1])
    torch.set_num_threads(1)
    sizes = json.loads(sys.argv[2])
    args = SimpleNamespace(**SETTINGS, **sizes)
    one, per_agent = {"vshape": (1,)}, {"group": "agents"}
    scheme = {
        "state": {"vshape": args.state_shape},
        "obs": {"vshape": args.obs_shape, **per_agent},
        "actions": {**one, **per_agent, "dtype": torch.long},
        "actions_onehot": {"vshape": (args.n_actions,), **per_agent},
        "avail_actions": {"vshape": (args.n_actions,), **per_agent, "dtype": torch.int},
        "reward": one,
        "terminated": {**one, "dtype": torch.uint8},
    }
    mac = importlib.import_module("controllers.basic_controller").BasicMAC(scheme, None, args)
    learners = importlib.import_module("learners.maser_q_learner")
    logger = SimpleNamespace(log_stat=lambda *_: None)
    learner = learners.maserQLearner(mac, scheme, logger, args)
    for _ in sys.stdin:
        batch = make_batch(sizes, scheme)
        start = time.process_time()
        learner.train(batch, t_env=0, episode_num=0)
        print(time.process_time() - start, flush=True)


if __name__ == "__main__":
    main()
