"""Record results of the authors' code of HMASD, for the tests to compare with.

python tests/golden/record_hmasd.py CHECKOUT    (a folder that contains their package `hmasd`)

Needs torch 2.13.0 and NumPy. Their runner for Alice_and_Bob does one rollout and all learning from
it. Inputs and weights are random and small. Episodes end inside segments, inside sequences and at
the end of a segment, with and without reward. Agents die, ratios are clipped, and value errors
exceed the quadratic part of the Huber loss.
"""

import argparse
import importlib
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import torch

T, E, N, K = 6, 4, 3, 2  # steps, copies, agents, steps of a segment
OBS, STATE, ACTIONS = 5, 7, 4
LEVELS = {
    "clip_param": 0.2, "ppo_epoch": 2, "num_mini_batch": 1, "value_loss_coef": 0.7,
    "max_grad_norm": 0.3, "huber_delta": 0.5, "use_max_grad_norm": True,
    "use_clipped_value_loss": True, "use_huber_loss": True, "use_value_active_masks": False,
    "use_policy_active_masks": True, "lr": 0.01, "critic_lr": 0.01, "opti_eps": 1e-5,
    "weight_decay": 0, "gamma": 0.9, "gae_lambda": 0.8, "use_gae": True,
    "use_proper_time_limits": False,
}  # fmt: skip
"""Settings of both levels, `h_...` and `l_...`."""
SETTINGS = {
    "hidden_size": 8, "layer_N": 1, "use_orthogonal": True, "use_ReLU": True, "gain": 0.01,
    "use_feature_normalization": True, "stacked_frames": 1, "recurrent_N": 1,
    "use_recurrent_policy": True, "use_naive_recurrent_policy": False, "use_popart": False,
    "use_valuenorm": True, "data_chunk_length": 3, "n_block": 1, "n_embd": 8, "n_head": 2,
    "dec_actor": False, "algorithm_name": "hmasd", "env_name": "alice_and_bob",
    "skill_type": "Discrete", "policy_use_both_skill": 0, "skill_interval": K,
    "h_entropy_coef": 0.05, "l_entropy_coef": 0.02,
    "d_team_lr": 0.01, "d_indi_lr": 0.01, "d_opti_eps": 1e-5, "d_weight_decay": 0, "d_epoch": 3,
    "d_num_mini_batch": 1, "d_max_grad_norm": 0.3, "d_use_max_grad_norm": True,
    "use_recurrent_discri": 0, "intri_rew_exp": 0, "lambda_env": 5.0, "lambda_team": 0.3,
    "lambda_indi": 0.7, "use_centralized_V": True, "num_env_steps": T * E, "episode_length": T,
    "n_rollout_threads": E, "use_linear_lr_decay": False,
}  # fmt: skip
VARIANTS = {
    "last_layer": {"skill_last_layer": 1, "team_skill_dim": 2, "indi_skill_dim": 3},
    "input": {"skill_last_layer": 0, "team_skill_dim": 3, "indi_skill_dim": 2},
}


class Discrete:
    """Stand-in for gym's action space of this name, which the original checks."""

    n = ACTIONS


class Copies:
    """Environment copies that show recorded random inputs, whatever the agents do."""

    observation_space = [[OBS]] * N
    share_observation_space = [[STATE]] * N
    action_space = [Discrete()] * N

    def __init__(self, inputs: dict[str, np.ndarray]):
        self.inputs, self.time = inputs, 0

    def reset(self):
        return self.seen()

    def seen(self):
        """Return observations, a state for each agent, and legal actions."""
        obs, state, legal = (self.inputs[name][self.time] for name in ("obs", "state", "legal"))
        return obs, np.repeat(state[:, None], N, axis=1), legal.astype(np.float32)

    def step(self, actions: np.ndarray):
        reward = np.repeat(self.inputs["reward"][self.time][:, None, None], N, axis=1)
        self.time += 1
        first = self.inputs["first"][self.time]
        dones = first[:, None] | ~self.inputs["alive"][self.time]
        obs, state, legal = self.seen()
        return obs, state, reward, dones, [{}] * E, legal


def draw_inputs(rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Draw rewards of T steps, and what is seen at T + 1."""
    first = np.zeros((T + 1, E), bool)
    first[[0, 0, 0, 0], range(E)] = True
    first[[1, 4, 5, 6], [0, 1, 2, 3]] = True  # inside a segment, at the end of one, of all
    first[2, 2] = True
    alive = (rng.random((T + 1, E, N)) < 0.75) | first[..., None]
    alive[..., 0] |= ~alive.any(-1)  # an episode ends when all are dead
    legal = (rng.random((T + 1, E, N, ACTIONS)) < 0.6) & alive[..., None]
    legal[..., 0] = ~alive  # doing nothing is legal for the dead only
    legal[..., 1:3] |= alive[..., None]
    reward = np.where(rng.random((T, E)) < 0.5, rng.normal(size=(T, E)), 0.0)
    reward[0, 0], reward[4, 2] = 2.0, 2.0  # success where episodes end inside segments
    return {
        "obs": rng.normal(size=(T + 1, E, N, OBS)).astype(np.float32) * alive[..., None],
        "state": rng.normal(size=(T + 1, E, STATE)).astype(np.float32),
        "legal": legal,
        "alive": alive,
        "first": first,
        "reward": reward.astype(np.float32),
    }


def randomize(module: torch.nn.Module) -> None:
    """Replace all weights by larger random ones, since small initial gains would hide mistakes."""
    with torch.no_grad():
        for parameter in module.parameters():
            center = float(parameter.mean() == 1)  # the scale of a LayerNorm
            parameter.copy_(center + 0.4 * torch.randn_like(parameter))


def weights(runner) -> dict[str, np.ndarray]:
    """Return copies of all parameters by dotted name."""
    nets = {
        "coordinator": runner.h_policy.transformer, "actor": runner.l_policy.actor,
        "critic": runner.l_policy.critic, "team": runner.discri.team_discri,
        "individual": runner.discri.indi_discri,
    }  # fmt: skip
    named = [
        (f"{net}.{k}", p) for net, module in nets.items() for k, p in module.named_parameters()
    ]
    return {name: parameter.detach().numpy().copy() for name, parameter in named}


def statistics(norm) -> np.ndarray:
    """Return the state of a value normalizer."""
    parts = (norm.running_mean, norm.running_mean_sq, norm.debiasing_term)
    return np.array([float(x) for x in parts], np.float32)


def make_recorder(runner_type: type, out: dict[str, np.ndarray], rng: np.random.Generator) -> type:
    """Return their runner, which records what it computes, from somewhat moved old results."""

    class Recorder(runner_type):
        def compute(self):
            high, low = self.h_buffer, self.l_buffer
            for name, buffer, shape in (("high", high, ()), ("low", low, (T, E, 1, 1))):
                out[f"{name}_log_prob"] = buffer.action_log_probs[..., 0].copy()
                out[f"{name}_value"] = buffer.value_preds[:-1, ..., 0].copy()
                moved = 0.3 * rng.normal(size=buffer.action_log_probs.shape)
                if name == "low":  # the log-probability of a single legal action is 0
                    moved[~out["alive"][:-1]] = 0
                buffer.action_log_probs += moved
                buffer.value_preds[:-1] += 0.5 * rng.normal(
                    size=shape or buffer.value_preds[:-1].shape
                )
                out[f"old_{name}_log_prob"] = buffer.action_log_probs[..., 0].copy()
                out[f"old_{name}_value"] = buffer.value_preds[:-1, ..., 0].copy()
            out["skills"] = high.actions[..., 0].astype(np.int32)
            out["action"] = low.actions[..., 0].astype(np.int32)
            out["low_reward"] = low.rewards[..., 0].copy()
            out["high_reward"] = high.rewards[..., 0, 0].copy()
            out["memory"] = low.rnn_states[..., 0, :].copy()
            out["critic_memory"] = low.rnn_states_critic[:, :, 0, 0].copy()
            get_actions = self.h_policy.get_actions
            out["greedy_skills"] = np.stack([
                get_actions(*map(np.concatenate, seen), deterministic=True)[1].view(E, 1 + N)
                for seen in zip(high.share_obs, high.obs)
            ]).astype(np.int32)  # fmt: skip

            def remember(*inputs):
                result = get_actions(*inputs)
                out["next_skills"] = result[1].numpy().reshape(E, 1 + N).astype(np.int32)
                return result

            self.h_policy.get_actions = remember
            super().compute()
            out["next_high_value"] = high.value_preds[-1, ..., 0].copy()
            out["next_low_value"] = low.value_preds[-1, ..., 0].copy()
            out["high_target"] = high.returns[:-1, ..., 0].copy()
            out["high_advantage"] = high.advantages[..., 0].copy()
            out["low_target"] = low.returns[:-1, ..., 0].copy()

        def train(self):
            info = super().train()
            out.update({f"info.{name}": np.float32(float(x)) for name, x in info.items()})
            return info

    return Recorder


def record(variant: dict[str, int]) -> dict[str, np.ndarray]:
    """Record one rollout and the learning from it."""
    torch.manual_seed(0)
    rng = np.random.default_rng(0)
    levels = {f"{level}_{name}": x for level in "hl" for name, x in LEVELS.items()}
    inputs = draw_inputs(rng)
    out = dict(inputs)  # and what their runner computes
    runner_type = importlib.import_module("hmasd.runner.shared.alice_and_bob_runner").AliceBobRunner
    runner = make_recorder(runner_type, out, rng)({
        "all_args": SimpleNamespace(**SETTINGS, **levels, **variant), "envs": Copies(inputs),
        "eval_envs": None, "device": torch.device("cpu"), "num_agents": N, "run_dir": None,
    })  # fmt: skip
    nets = (
        runner.h_policy.transformer, runner.l_policy.actor, runner.l_policy.critic,
        runner.discri.team_discri, runner.discri.indi_discri,
    )  # fmt: skip
    for net in nets:
        randomize(net)
    norms = {"high": runner.h_trainer.value_normalizer, "low": runner.l_trainer.value_normalizer}
    for name, norm in norms.items():
        norm.update(torch.tensor([[3.0], [-1.0], [2.0]]))
        out[f"{name}_norm"] = statistics(norm)
    before = weights(runner)
    runner.run()
    out |= {f"{name}_norm_after": statistics(norm) for name, norm in norms.items()}
    out |= {f"before/{k}": x for k, x in before.items()}
    out |= {f"after/{k}": x for k, x in weights(runner).items()}
    return {k: x.astype(np.float32) if x.dtype == np.float64 else x for k, x in out.items()}


def main() -> None:
    """Write the tables of both places of skills next to this file."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("checkout", type=Path)
    sys.path.insert(0, str(parser.parse_args().checkout))
    for name, variant in VARIANTS.items():
        table = record(variant) | {"torch": np.array(torch.__version__)}
        np.savez_compressed(Path(__file__).parent / "hmasd" / f"{name}.npz", **table)


if __name__ == "__main__":
    main()
