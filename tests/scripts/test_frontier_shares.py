import jax
import jax.numpy as jnp

import envs_jax
from hmasd_jax.exploration.bonus import add
from hmasd_jax.exploration.frontier import Frontier, make_frontier
from hmasd_jax.exploration.frontier_config import FrontierConfig
from hmasd_jax.exploration.novelty import NoveltyConfig, make_novelty
from scripts.frontier_shares import find_frontier, list_shares


def test_the_frontier_is_found_beside_another_bonus():
    env = envs_jax.make("probe_match_cue")
    frontier = make_frontier(env, FrontierConfig(coef=1.0), num_envs=3)
    novelty = make_novelty(env, NoveltyConfig(coef=1.0))
    for bonus, found in ((frontier, True), (add(novelty, frontier), True), (novelty, False)):
        state = bonus.init(jax.random.key(0))
        assert isinstance(find_frontier(state), Frontier) is found
    assert find_frontier(()) is None


def test_shares_of_one_feature_by_direction_and_bin():
    env = envs_jax.make("probe_match_cue")
    bonus = make_frontier(env, FrontierConfig(coef=1.0, num_bins=2), num_envs=3)
    frontier = bonus.init(jax.random.key(0))._replace(
        low=jnp.array([0.0, -1.0]),
        high=jnp.array([4.0, 1.0]),
        reached=jnp.array([[[5.0, 0.0], [0.0, 2.0]], [[0.0, 0.0], [1.0, 0.0]]]),
        parts=jnp.array([4.0, 3.0, 3.0]),
        mastered=jnp.array([[[1.0, 0.25], [0.0, 0.75]], [[0.0, 0.0], [0.5, 0.0]]]),
    )
    rows = [tuple(row.values()) for row in list_shares(frontier, 1)]
    assert rows == [
        ("rising", -1.0, 0.0, 0.0, 0.0),
        ("rising", 0.0, 1.0, 0.75, 0.2),
        ("falling", -1.0, 0.0, 0.5, 0.1),
        ("falling", 0.0, 1.0, 0.0, 0.0),
    ]
