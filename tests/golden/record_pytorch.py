"""Record results of the original PyTorch code of MAPPO and MAT, for the tests to compare with.

python tests/golden/record_pytorch.py mappo CHECKOUT    (of marlbenchmark/on-policy)
python tests/golden/record_pytorch.py mat CHECKOUT      (of PKU-MARL/Multi-Agent-Transformer)

Needs torch 2.13.0 and NumPy. Inputs and weights are random and small. A rollout has episodes that
end inside sequences, agents that die, clipped ratios, and value errors beyond the quadratic part of
the Huber loss.
"""

import argparse
import importlib
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import torch

T, E, N = 6, 4, 3  # steps, copies, agents
OBS, STATE, ACTIONS = 5, 7, 4
FLAGS = [
    "--hidden_size=8", "--data_chunk_length=3", f"--episode_length={T}", f"--n_rollout_threads={E}",
    "--lr=0.01", "--critic_lr=0.01", "--ppo_epoch=2", "--num_mini_batch=1", "--max_grad_norm=0.3",
    "--entropy_coef=0.05", "--value_loss_coef=0.7", "--clip_param=0.2",
    "--use_value_active_masks",  # turns them off, as in all scripts for SMAC
]  # fmt: skip


class Discrete:
    """Stand-in for gym's action space of this name; the originals also check its name."""

    n = ACTIONS


def setup(package: str, checkout: Path, more: list[str]) -> tuple[SimpleNamespace, SimpleNamespace]:
    """Import the modules of `package` from `checkout` and parse its settings."""
    sys.path.insert(0, str(checkout))
    parser = importlib.import_module(f"{package}.config").get_config()
    args, _ = parser.parse_known_args(FLAGS + more)
    buffer = importlib.import_module(f"{package}.utils.shared_buffer")
    return SimpleNamespace(Buffer=buffer.SharedReplayBuffer), args


def randomize(module: torch.nn.Module) -> None:
    """Replace all weights by larger random ones, since small initial gains would hide mistakes."""
    with torch.no_grad():
        for parameter in module.parameters():
            center = float(parameter.mean() == 1)  # the scale of a LayerNorm
            parameter.copy_(center + 0.4 * torch.randn_like(parameter))


def weights(**modules: torch.nn.Module) -> dict[str, np.ndarray]:
    """Return copies of all parameters by dotted name."""
    named = [(f"{m}.{k}", p) for m, net in modules.items() for k, p in net.named_parameters()]
    return {name: parameter.detach().numpy().copy() for name, parameter in named}


def draw_inputs(rng: np.random.Generator, state_of) -> dict[str, np.ndarray]:
    """Draw rewards of T steps, and observations, states and masks of T + 1."""
    alive = rng.random((T + 1, E, N)) < 0.8
    legal = (rng.random((T + 1, E, N, ACTIONS)) < 0.6) & alive[..., None]
    legal[..., 0] = ~alive  # doing nothing is legal for the dead only
    legal[..., 1:3] |= alive[..., None]  # the living always have a choice
    obs = rng.normal(size=(T + 1, E, N, OBS)) * alive[..., None]
    state = rng.normal(size=(T + 1, E, STATE))
    first = rng.random((T + 1, E)) < 0.3
    return {
        "obs": obs.astype(np.float32),
        "state": state.astype(np.float32),
        "critic_state": state_of(state, obs, alive).astype(np.float32),
        "legal": legal,
        "alive": alive,
        "first": first,
        "reward": 5 * rng.normal(size=(T, E)).astype(np.float32),
    }


def shared_state(state, obs, alive):
    """Return the same state for every agent."""
    return np.repeat(state[:, :, None], N, axis=2)


def agent_state(state, obs, alive):
    """Return state, observation and one-hot index of each agent; for the dead only the index."""
    seen = np.concatenate([shared_state(state, obs, alive), obs], axis=-1) * alive[..., None]
    index = np.broadcast_to(np.eye(N), (T + 1, E, N, N))
    return np.concatenate([seen, index], axis=-1)


def to_numpy(x: torch.Tensor) -> np.ndarray:
    """Convert (E N, ...) to a NumPy array (E, N, ...)."""
    return x.detach().numpy().reshape(E, N, *x.shape[1:])


def fill(buffer, policy, inputs: dict, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Act for T steps and fill the buffer.

    The stored old log-probabilities and values differ a little from those of the networks.
    """
    out = {"action": [], "log_prob": [], "value": [], "greedy": []}
    buffer.share_obs[:], buffer.obs[:] = inputs["critic_state"], inputs["obs"]
    buffer.available_actions[:] = inputs["legal"]
    buffer.active_masks[:] = inputs["alive"][..., None]
    buffer.masks[:] = 1.0 - inputs["first"][:, :, None, None]
    buffer.rewards[:] = inputs["reward"][:, :, None, None]

    def arguments(t):
        fields = (
            buffer.share_obs, buffer.obs, buffer.rnn_states, buffer.rnn_states_critic,
            buffer.masks, buffer.available_actions,
        )  # fmt: skip
        return [np.concatenate(x[t]) for x in fields]

    with torch.no_grad():
        for t in range(T):
            greedy = policy.get_actions(*arguments(t), deterministic=True)[1]
            value, action, log_prob, actor, critic = policy.get_actions(*arguments(t))
            buffer.rnn_states[t + 1] = to_numpy(actor)
            buffer.rnn_states_critic[t + 1] = to_numpy(critic)
            buffer.actions[t] = to_numpy(action)
            new = {"action": action, "log_prob": log_prob, "value": value, "greedy": greedy}
            for name, x in new.items():
                out[name].append(to_numpy(x)[..., 0])
        share_obs, obs, _, critic, masks, _ = arguments(T)
        inputs_of_value = (share_obs, critic, masks)
        if policy.__class__.__name__ == "TransformerPolicy":
            inputs_of_value = (share_obs, obs, critic, masks)
        last_value = to_numpy(policy.get_values(*inputs_of_value))
    out = {name: np.stack(x) for name, x in out.items()}
    moved = 0.3 * rng.normal(size=(T, E, N))
    moved[~inputs["alive"][:-1]] = 0  # the log-probability of a single legal action is 0
    old_value = out["value"] + 0.5 * rng.normal(size=(T, E, 1))
    buffer.action_log_probs[:] = (out["log_prob"] + moved)[..., None]
    buffer.value_preds[:-1] = old_value[..., None]
    out |= {"old_log_prob": buffer.action_log_probs[..., 0].copy()}
    out |= {"old_value": buffer.value_preds[:-1, ..., 0].copy(), "last_value": last_value[..., 0]}
    return out | {"memory": buffer.rnn_states.copy(), "critic_memory": buffer.rnn_states_critic}


def train(trainer, buffer, last_value: np.ndarray) -> dict[str, np.ndarray]:
    """Compute returns by GAE, and train both epochs of one call of their trainer."""
    norm = trainer.value_normalizer
    statistics = (norm.running_mean, norm.running_mean_sq, norm.debiasing_term)
    norm.update(torch.tensor([[3.0], [-1.0], [2.0]]))
    out = {"norm": np.array([float(x) for x in statistics], np.float32)}
    buffer.compute_returns(last_value[..., None], norm)
    out["target"] = buffer.returns[:-1, ..., 0].copy()
    out["denormalized"] = norm.denormalize(np.linspace(-2, 2, 5, dtype=np.float32)[:, None])
    info = trainer.train(buffer)
    out["norm_after"] = np.array([float(x) for x in statistics], np.float32)
    return out | {f"info.{name}": np.float32(float(x)) for name, x in info.items()}


def record_mappo(checkout: Path, recurrent: bool) -> dict[str, np.ndarray]:
    """Record on-policy's MAPPO, either recurrent with a shared state or with a state per agent."""
    more = ["--algorithm_name=rmappo", "--huber_delta=0.5"]
    more += [] if recurrent else ["--use_recurrent_policy"]  # turns it off
    modules, args = setup("onpolicy", checkout, more)
    policies = importlib.import_module("onpolicy.algorithms.r_mappo.algorithm.rMAPPOPolicy")
    trainers = importlib.import_module("onpolicy.algorithms.r_mappo.r_mappo")
    rng = np.random.default_rng(0)
    inputs = draw_inputs(rng, shared_state if recurrent else agent_state)
    state_dim = inputs["critic_state"].shape[-1]
    policy = policies.R_MAPPOPolicy(args, [OBS], [state_dim], Discrete())
    randomize(policy.actor)
    randomize(policy.critic)
    before = weights(actor=policy.actor, critic=policy.critic)
    buffer = modules.Buffer(args, N, [OBS], [state_dim], Discrete())
    outputs = fill(buffer, policy, inputs, rng)
    outputs |= train(trainers.R_MAPPO(args, policy), buffer, outputs["last_value"])
    after = weights(actor=policy.actor, critic=policy.critic)
    return pack(inputs | outputs, before, after)


def record_mat(checkout: Path) -> dict[str, np.ndarray]:
    """Record MAT, with errors within the Huber threshold: beyond it, their loss drops one sign."""
    more = ["--algorithm_name=mat", "--huber_delta=50", "--n_block=2", "--n_embd=8", "--n_head=2"]
    modules, args = setup("mat", checkout, more)
    policies = importlib.import_module("mat.algorithms.mat.algorithm.transformer_policy")
    trainers = importlib.import_module("mat.algorithms.mat.mat_trainer")
    rng = np.random.default_rng(1)
    inputs = draw_inputs(rng, shared_state)
    args.env_name = "none"
    policy = policies.TransformerPolicy(args, [OBS], [STATE], Discrete(), N)
    randomize(policy.transformer)
    before = weights(mat=policy.transformer)
    buffer = modules.Buffer(args, N, [OBS], [STATE], Discrete(), "none")
    outputs = fill(buffer, policy, inputs, rng)
    outputs |= train(trainers.MATTrainer(args, policy, N), buffer, outputs["last_value"])
    return pack(inputs | outputs, before, weights(mat=policy.transformer))


def pack(arrays: dict, before: dict, after: dict) -> dict[str, np.ndarray]:
    """Return one table of all arrays, weights before and after, and the version of torch."""
    table = arrays | {f"before/{k}": x for k, x in before.items()}
    table |= {f"after/{k}": x for k, x in after.items()}
    table = {k: x.astype(np.float32) if x.dtype == np.float64 else x for k, x in table.items()}
    return table | {"torch": np.array(torch.__version__)}


def main() -> None:
    """Write the tables of one original next to this file."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("original", choices=["mappo", "mat"])
    parser.add_argument("checkout", type=Path)
    options = parser.parse_args()
    torch.manual_seed(0)
    folder = Path(__file__).parent / options.original
    if options.original == "mat":
        np.savez_compressed(folder / "mat.npz", **record_mat(options.checkout))
        return
    for name, recurrent in [("recurrent", True), ("feed_forward", False)]:
        np.savez_compressed(folder / f"{name}.npz", **record_mappo(options.checkout, recurrent))


if __name__ == "__main__":
    main()
