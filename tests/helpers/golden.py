"""Numbers recorded in tests/golden, and weights of the originals' PyTorch networks as ours."""

from pathlib import Path

import numpy as np

GOLDEN = Path(__file__).parents[1] / "golden"


def linear(table, name):
    bias = {"bias": table[f"{name}.bias"]} if f"{name}.bias" in table else {}
    return {"kernel": table[f"{name}.weight"].T, **bias}


def norm(table, name):
    return {"scale": table[f"{name}.weight"], "bias": table[f"{name}.bias"]}


def mlp(table, net):
    """Parameters of `MLP`."""
    return {
        "LayerNorm_0": norm(table, f"{net}.base.feature_norm"),
        "Dense_0": linear(table, f"{net}.base.mlp.fc1.0"),
        "LayerNorm_1": norm(table, f"{net}.base.mlp.fc1.2"),
        "Dense_1": linear(table, f"{net}.base.mlp.fc2.0.0"),
        "LayerNorm_2": norm(table, f"{net}.base.mlp.fc2.0.2"),
    }


def actor_or_critic(table, net, head):
    """Parameters of `RecurrentNet`, of `FeedForwardNet`, or of `Classifier`."""
    params = {"MLP_0": mlp(table, net), "head": linear(table, f"{net}.{head}")}
    gru = f"{net}.rnn.rnn"
    if f"{gru}.weight_ih_l0" in table:
        weight, bias = f"{gru}.weight_{{}}_l0", f"{gru}.bias_{{}}_l0"
        params["GRU_0"] = {
            "input": {"kernel": table[weight.format("ih")].T, "bias": table[bias.format("ih")]},
            "kernel": table[weight.format("hh")].T,
            "bias": table[bias.format("hh")],
        }
        params["LayerNorm_0"] = norm(table, f"{net}.rnn.norm")
    return {"params": params}


def head(table, name):
    """Parameters of `Head`."""
    return {
        "Dense_0": linear(table, f"{name}.0"),
        "LayerNorm_0": norm(table, f"{name}.2"),
        "Dense_1": linear(table, f"{name}.3"),
    }


def block(table, name, attentions):
    """Parameters of `EncoderBlock` or `DecoderBlock`."""
    names = {"query": "query", "key": "key", "value": "value", "output": "proj"}
    # Flax numbers layers as they are made, and the outer one is made first.
    feed_forward = {f"Dense_{i}": linear(table, f"{name}.mlp.{2 - 2 * i}") for i in range(2)}
    params = {"FeedForward_0": feed_forward}
    for i, attention in enumerate(attentions):
        params[f"Attention_{i}"] = {
            ours: linear(table, f"{name}.{attention}.{theirs}") for ours, theirs in names.items()
        }
    norms = {f"LayerNorm_{i}": norm(table, f"{name}.ln{i + 1}") for i in range(len(attentions) + 1)}
    return params | norms


def load(name):
    """Results, and weights before and after training."""
    with np.load(GOLDEN / f"{name}.npz") as file:
        table = dict(file)
    parts = {"before": {}, "after": {}}
    for key in [key for key in table if "/" in key]:
        when, parameter = key.split("/")
        parts[when][parameter] = table.pop(key)
    return table, parts["before"], parts["after"]
