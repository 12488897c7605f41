"""Record results of the original PyTorch code of MASER, for the tests to compare with.

python tests/golden/record_maser.py CHECKOUT    (of Jiwonjeon9603/MASER)

Its learner is also that of QMIX and VDN, by its settings. Needs torch 2.13.0 and NumPy. Inputs and
weights are random and small. Episodes have different lengths, agents die, the target networks
differ from those that learn, and gradients are clipped.
"""

import argparse
import importlib
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch

T, B, N = 6, 4, 3  # steps of the longest episode, episodes, agents
OBS, STATE, ACTIONS = 5, 7, 4
LENGTHS = np.array([6, 4, 6, 3])
SETTINGS = {
    "n_agents": N, "n_actions": ACTIONS, "state_shape": STATE, "device": "cpu",
    "rnn_hidden_dim": 8, "mixing_embed_dim": 6, "agent": "rnn", "agent_output_type": "q",
    "obs_last_action": True, "obs_agent_id": True, "double_q": True, "gamma": 0.9,
    "lr": 0.01, "optim_alpha": 0.97, "optim_eps": 1e-3, "grad_norm_clip": 2.0,
    "action_selector": "epsilon_greedy", "epsilon_start": 1.0, "epsilon_finish": 0.05,
    "epsilon_anneal_time": 100, "target_update_interval": 200, "learner_log_interval": 1,
    "lam": 0.3, "alpha": 0.6, "ind": 800.0, "mix": 0.2, "expl": 0.3, "dis": 0.7,
}  # fmt: skip
KEPT = {
    "mac_out": "values", "chosen_action_qvals": "total", "goal_target_max_qvals": "goal_total",
    "targets": "target", "ddqn_qval_up_idx": "goal", "intrinsic_rewards_ind": "intrinsic",
    "rewards": "shaped_reward", "individual_targets": "individual_target",
    "individual_loss": "individual_loss", "loss": "loss",
}  # fmt: skip
"""Variables of their `train`, and what they are called in the records."""


def draw_inputs(rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Draw actions and rewards of T steps, and observations, states and masks of T + 1."""
    steps = np.arange(T + 1)
    alive = rng.random((B, T + 1, N)) < 0.8
    legal = (rng.random((B, T + 1, N, ACTIONS)) < 0.6) & alive[..., None]
    legal[..., 0] = ~alive  # doing nothing is legal for the dead only
    legal[..., 1] |= alive
    seen = steps <= LENGTHS[:, None]  # the step after the last is seen, too
    legal &= seen[..., None, None]
    action = (rng.random(legal.shape) * legal).argmax(-1) * seen[..., None]
    obs = rng.normal(size=(B, T + 1, N, OBS)) * alive[..., None] * seen[..., None, None]
    return {
        "obs": obs.astype(np.float32),
        "state": (rng.normal(size=(B, T + 1, STATE)) * seen[..., None]).astype(np.float32),
        "legal": legal,
        "action": action,
        "reward": (3 * rng.normal(size=(B, T + 1)) * (steps < LENGTHS[:, None])).astype(np.float32),
        "terminated": (steps == LENGTHS[:, None] - 1) & (np.arange(B) != 2)[:, None],
        "length": LENGTHS,
    }


def make_batch(inputs: dict[str, np.ndarray]) -> Any:
    """Fill their batch of episodes with new copies, since their learner writes into it."""
    module = importlib.import_module("components.episode_buffer")
    one = {"vshape": (1,)}
    per_agent = {"group": "agents", "dtype": torch.long}
    scheme = {
        "state": {"vshape": STATE},
        "obs": {"vshape": OBS, "group": "agents"},
        "actions": {**one, **per_agent},
        "actions_onehot": {"vshape": (ACTIONS,), "group": "agents"},
        "avail_actions": {"vshape": (ACTIONS,), **per_agent},
        "reward": one,
        "terminated": {**one, "dtype": torch.uint8},
    }
    batch = module.EpisodeBatch(scheme, {"agents": N}, B, T + 1)
    values = {
        "state": inputs["state"],
        "obs": inputs["obs"],
        "actions": inputs["action"][..., None],
        "actions_onehot": np.eye(ACTIONS)[inputs["action"]],
        "avail_actions": inputs["legal"],
        "reward": inputs["reward"][..., None],
        "terminated": inputs["terminated"][..., None],
        "filled": (np.arange(T + 1) <= LENGTHS[:, None])[..., None],
    }
    for name, value in values.items():
        batch.data.transition_data[name][:] = torch.tensor(value)
    return batch


def randomize(module: torch.nn.Module) -> None:
    """Replace all weights by larger random ones."""
    with torch.no_grad():
        for parameter in module.parameters():
            parameter.copy_(0.5 * torch.randn_like(parameter))


def weights(learner: Any, target: bool = False) -> dict[str, np.ndarray]:
    """Return copies of all parameters by dotted name."""
    mac, mixer = ("target_mac", "target_mixer") if target else ("mac", "mixer")
    modules = {"agent": getattr(learner, mac).agent, "mixer": getattr(learner, mixer)}
    modules |= {} if target else {"distance": learner.distance}
    named = [(f"{m}.{k}", p) for m, net in modules.items() for k, p in net.named_parameters()]
    return {name: parameter.detach().numpy().copy() for name, parameter in named}


def train(learner: Any, batch: Any) -> dict[str, np.ndarray]:
    """Train one step, and return the variables of their function when it returns."""
    found = {}

    def on_return(frame, event, _):
        if event == "return" and frame.f_code is type(learner).train.__code__:
            found.update(frame.f_locals)

    sys.setprofile(on_return)
    try:
        learner.train(batch, t_env=1, episode_num=1)
    finally:
        sys.setprofile(None)
    kept = {ours: found[theirs] for theirs, ours in KEPT.items() if theirs in found}
    return {name: np.asarray(x.detach()).squeeze() for name, x in kept.items()}


def record(mixer: str, goal: str) -> dict[str, np.ndarray]:
    """Record two steps of their learner on the same batch."""
    args = SimpleNamespace(**SETTINGS, mixer=mixer, goal=goal)
    controllers = importlib.import_module("controllers.basic_controller")
    learners = importlib.import_module("learners.maser_q_learner")
    torch.manual_seed(0)
    inputs = draw_inputs(np.random.default_rng(7))
    scheme = {"obs": {"vshape": OBS}, "actions_onehot": {"vshape": (ACTIONS,)}}
    mac = controllers.BasicMAC(scheme, None, args)
    logger = SimpleNamespace(log_stat=lambda *_: None)
    learner = learners.maserQLearner(mac, scheme, logger, args)
    modules = (mac.agent, learner.mixer, learner.target_mac.agent, learner.target_mixer)
    for module in (*modules, learner.distance):
        randomize(module)
    arrays = {f"target/{k}": x for k, x in weights(learner, target=True).items()}
    arrays |= {f"before/{k}": x for k, x in weights(learner).items()}
    outputs, later = (train(learner, make_batch(inputs)) for _ in range(2))
    if goal == "maser" and any((x["goal"] >= LENGTHS[:, None]).any() for x in (outputs, later)):
        raise SystemExit("a subgoal is in the padding, where ours never is: draw other inputs")
    arrays |= {f"after/{k}": x for k, x in weights(learner).items()}
    arrays |= inputs | outputs
    arrays = {k: x.astype(np.float32) if x.dtype == np.float64 else x for k, x in arrays.items()}
    return arrays | {"torch": np.array(torch.__version__)}


def main() -> None:
    """Record one file per algorithm."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("checkout", type=Path, help="folder of the original repository")
    sys.path.insert(0, str(parser.parse_args().checkout))
    out = Path(__file__).parent / "maser"
    out.mkdir(exist_ok=True)
    for name, mixer, goal in (
        ("maser", "qmix", "maser"), ("qmix", "qmix", "none"), ("vdn", "vdn", "none"),
    ):  # fmt: skip
        np.savez_compressed(out / f"{name}.npz", **record(mixer, goal))


if __name__ == "__main__":
    main()
