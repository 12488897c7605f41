import jax.numpy as jnp

from hmasd_jax.exploration.frontier import Frontier
from hmasd_jax.rl.moments import Moments
from scripts.frontier_shares import list_shares


def test_shares_of_one_feature_by_bin():
    frontier = Frontier(
        low=jnp.array([0.0, -1.0]),
        high=jnp.array([4.0, 1.0]),
        reached=jnp.array([[5.0, 0.0], [10.0, 2.0]]),
        episodes=jnp.float32(10.0),
        mastered=jnp.array([[1.0, 0.25], [1.0, 0.75]]),
        visited=jnp.zeros((3, 2, 2), bool),
        bonuses=Moments.create(),
    )
    assert list_shares(frontier, 1) == [
        {"from": -1.0, "to": 0.0, "largest_share": 1.0, "recent_share": 1.0},
        {"from": 0.0, "to": 1.0, "largest_share": 0.75, "recent_share": 0.2},
    ]
