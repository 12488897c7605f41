"""The script that records soups: the pots that they come from."""

import numpy as np

from envs_jax.overcooked.layouts import read
from envs_jax.overcooked.rules import COOKING, POT
from scripts.soup_times import soups_from


def test_soups_are_counted_for_the_pot_that_they_leave():
    start = read("asymmetric_advantages").grid
    upper, lower = np.flatnonzero(start == POT)
    grid = np.tile(start, (6, 1))
    grid[1:3, upper] = COOKING + 2  # cooks, and is taken at step 3
    grid[4, upper] = POT + 1  # an onion is no soup
    grid[2:5, lower] = COOKING + 5  # cooks on, and is taken at step 5
    assert soups_from(grid) == {str(upper): 1, str(lower): 1}
    assert soups_from(grid[:5]) == {str(upper): 1, str(lower): 0}
