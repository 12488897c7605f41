"""Annotations of types and shapes hold in every call of a training and of a policy."""

import subprocess
import sys

import pytest

from hmasd_jax.algorithms import ALGORITHMS
from scripts.records import ROOT

PRESETS = (
    ("alice_and_bob/hmasd", "alice_and_bob/vdn", "micro_battle/3m/maser", "micro_battle/3m/qmix"),
    ("alice_and_bob/nohigh", "alice_and_bob/noteam", "micro_battle/2s_vs_1sc/mat"),
    ("micro_battle/3m/hmasd_general", "micro_battle/3m/mappo", "micro_battle/3m/ippo"),
    ("overcooked/cramped_room/hmasd_general", "overcooked/cramped_room/edti"),
    ("overcooked/cramped_room/mappo_general", "overcooked/cramped_room/eiti"),
)
"""Each algorithm and each environment, with and without the parts of our presets."""


@pytest.mark.parametrize("presets", PRESETS, ids=lambda presets: presets[0])
def test_calls_are_as_annotated(presets):
    code = f"from tests.helpers import shapes; shapes.trace_all({presets})"
    command = [sys.executable, "-c", code]
    run = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert run.returncode == 0, run.stderr[-3000:]


def test_every_algorithm_is_traced():
    names = {
        preset.rsplit("/", 1)[1].removesuffix("_general") for group in PRESETS for preset in group
    }
    assert names >= ALGORITHMS.keys() - {"toy"}
