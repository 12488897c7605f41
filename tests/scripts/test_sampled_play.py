"""The script that sets sampled play beside greedy play."""

import jax.numpy as jnp

from envs_jax.probes import MatchCue
from hmasd_jax.runs.load import TrainedRun
from hmasd_jax.types import Algorithm, Policy
from scripts import sampled_play
from tests.helpers.random_play import RANDOM


def test_a_team_that_knows_the_answer_may_fail_when_it_samples(monkeypatch):
    def answer(memory, timestep, first, key):
        cues = timestep.state[..., -4:].reshape(-1, 2, 2)
        return memory, jnp.argmax(cues, axis=-1), ()

    env = MatchCue()
    policies = {True: Policy(lambda batch_shape: (), answer), False: RANDOM}
    algorithm = Algorithm(None, None, lambda state, greedy: policies[greedy])
    run = TrainedRun(config=None, env=env, algorithm=algorithm, state=None, env_steps=7)
    monkeypatch.setattr(sampled_play, "load_run", lambda path, seed: run)
    monkeypatch.setattr(sampled_play, "read_config", lambda path: None)
    monkeypatch.setattr(sampled_play, "build", lambda config: (env, algorithm))
    row = sampled_play.measure("run", 5)
    assert (row["seed"], row["env_steps"], row["greedy"]) == (5, 7, 1.0)
    assert 0.15 < row["sampled"] < 0.35  # both agents are right in a quarter of the games
