import jax
import jax.numpy as jnp

import envs_jax
from hmasd_jax.exploration.frontier import FrontierConfig, make_frontier
from scripts.frontier_shares import list_shares


def test_shares_of_one_feature_by_bin():
    env = envs_jax.make("probe_match_cue")
    bonus = make_frontier(env, FrontierConfig(coef=1.0, num_bins=2), num_envs=3)
    frontier = bonus.init(jax.random.key(0))._replace(
        low=jnp.array([0.0, -1.0]),
        high=jnp.array([4.0, 1.0]),
        reached=jnp.array([[5.0, 0.0], [10.0, 2.0]]),
        episodes=jnp.float32(10.0),
        mastered=jnp.array([[1.0, 0.25], [1.0, 0.75]]),
    )
    assert list_shares(frontier, 1) == [
        {"from": -1.0, "to": 0.0, "largest_share": 1.0, "recent_share": 1.0},
        {"from": 0.0, "to": 1.0, "largest_share": 0.75, "recent_share": 0.2},
    ]
