"""The original Python game as an oracle: conversion of states, random states, and cooking play.

Works with the packages `overcooked` (PyPI) and `overcooked_ai_py` (the original).
"""

import importlib
from types import SimpleNamespace

import numpy as np

from envs_jax.overcooked.environment import INTERACT, OvercookedState
from envs_jax.overcooked.environment import features as overcooked_features
from envs_jax.overcooked.layouts import read
from envs_jax.overcooked.rules import (
    COUNTER,
    DISH,
    FLOOR,
    IDLE,
    NOTHING,
    NUM_ITEMS,
    ONION,
    POT,
    READY,
    SOUP,
    pot_state,
    read_pot,
)

HORIZON = 400
ORDERS = [{"ingredients": ["onion"] * 3}]


class Oracle:
    """Kitchen of the Python game under one of the two rules for pots."""

    def __init__(self, package, layout, start_cooking):
        mdp = importlib.import_module(f"{package}.mdp.overcooked_mdp")
        planners = importlib.import_module(f"{package}.planning.planners")
        self.code, self.kitchen = mdp, read(layout)
        old = start_cooking == "auto"
        if "\n" in layout:
            grid = [list(row) for row in layout.strip("\n").split("\n")]
            params = {"start_all_orders": ORDERS, "old_dynamics": old}
            self.mdp = mdp.OvercookedGridworld.from_grid(grid, params)
        else:
            self.mdp = mdp.OvercookedGridworld.from_layout_name(layout, old_dynamics=old)
        planner = planners.MotionPlanner(self.mdp, counter_goals=[])

        # The package `overcooked` broke this method: its featurizer still passes `with_argmin`,
        # which the method no longer takes, and it fails if there is no location. Asking for the
        # cost of each location and comparing them does what the original does.
        def min_cost_to_feature(pose, locations, with_argmin):
            costs = [planner.min_cost_to_feature(pose, [location]) for location in locations]
            costs = [cost[0] if isinstance(cost, tuple) else cost for cost in costs]
            least = min(costs, default=np.inf)
            return least, None if np.isinf(least) else locations[costs.index(least)]

        self.planner = SimpleNamespace(
            motion_planner=SimpleNamespace(min_cost_to_feature=min_cost_to_feature)
        )

    def _xy(self, cell):
        return tuple(self.kitchen.xy(int(cell)).tolist())

    def _item(self, item, position):
        if item > SOUP:
            return self.code.SoupState.get_soup(
                position, num_onions=int(item - SOUP), finished=True
            )
        return self.code.ObjectState({ONION: "onion", DISH: "dish"}[int(item)], position)

    def theirs(self, state):
        """Convert our state to theirs."""
        players, objects = [], {}
        for pose, item in zip(state.pose, state.held):
            cell, orientation = divmod(int(pose), 4)
            position = self._xy(cell)
            held = None if item == NOTHING else self._item(item, position)
            direction = self.code.Direction.INDEX_TO_DIRECTION[orientation]
            players.append(self.code.PlayerState(position, direction, held))
        for cell, code in enumerate(state.grid.tolist()):
            position = self._xy(cell)
            if COUNTER < code < POT:
                objects[position] = self._item(code - COUNTER, position)
            elif code > POT:
                onions, cooked = read_pot(code)
                objects[position] = self.code.SoupState.get_soup(
                    position, num_onions=onions, cooking_tick=cooked
                )
        orders = {"all_orders": self.mdp.start_all_orders, "bonus_orders": []}
        return self.code.OvercookedState(players, objects, timestep=int(state.time), **orders)

    def ours(self, theirs, soups=0):
        """Convert their state to ours, as NumPy arrays; agent 0 is player 0."""

        def code(thing):
            if thing is None:
                return NOTHING
            if thing.name == "soup":
                return SOUP + len(thing.ingredients)
            return {"onion": ONION, "dish": DISH}[thing.name]

        grid = self.kitchen.grid.copy()
        for (x, y), thing in theirs.objects.items():
            cell = x + self.kitchen.width * y
            if grid[cell] == POT:
                grid[cell] = pot_state(len(thing.ingredients), thing._cooking_tick)
            else:
                grid[cell] = COUNTER + code(thing)
        directions = self.code.Direction.DIRECTION_TO_INDEX
        state = OvercookedState(
            pose=[
                4 * (p.position[0] + self.kitchen.width * p.position[1]) + directions[p.orientation]
                for p in theirs.players
            ],
            held=[code(p.held_object) for p in theirs.players],
            grid=grid,
            time=theirs.timestep,
            soups=soups,
            swapped=False,
        )
        return OvercookedState(*(np.array(x) for x in state))

    def step(self, theirs, action):
        """Return their state after a pair of actions, and the reward."""
        joint = tuple(self.code.Action.INDEX_TO_ACTION[int(a)] for a in action)
        theirs, info = self.mdp.get_state_transition(theirs, joint)
        return theirs, sum(info["sparse_reward_by_agent"])

    def features(self, theirs):
        """Return the features that both players observe, (2, 96)."""
        return np.array(self.mdp.featurize_state(theirs, self.planner))

    def lossless(self, theirs):
        """Return the lossless encoding that both players observe, flattened to (2, features)."""
        return np.array(self.mdp.lossless_state_encoding(theirs, horizon=HORIZON)).reshape(2, -1)


def random_state(rng, layout):
    """Draw any state, however unlikely; hands and counters are often full."""
    kitchen = read(layout)
    grid = kitchen.grid.copy()
    for cell in np.flatnonzero(grid == COUNTER):
        if rng.random() < 0.45:
            grid[cell] = COUNTER + rng.integers(1, NUM_ITEMS)
    for cell in kitchen.pots:
        onions = rng.integers(0, 4)
        cooked = rng.choice([IDLE, rng.integers(0, READY), READY])
        grid[cell] = pot_state(onions, cooked if onions else IDLE)
    state = OvercookedState(
        pose=4 * rng.permutation(np.flatnonzero(grid == FLOOR))[:2] + rng.integers(0, 4, 2),
        held=rng.integers(0, NUM_ITEMS, 2),
        grid=grid,
        time=rng.integers(0, HORIZON),
        soups=0,
        swapped=False,
    )
    return OvercookedState(*(np.array(x) for x in state))


def random_action(rng):
    """Draw a pair of actions, of which 60 % are interactions."""
    return np.where(rng.random(2) < 0.6, INTERACT, rng.integers(0, 6, 2))


def cooking_action(rng, features):
    """Draw a pair of actions given `features` (2, 96): three of four work towards a soup."""
    return np.array([_one_cook(rng, own) for own in features])


def _one_cook(rng, own):
    onion, soup, dish = own[4:7]
    pot = own[overcooked_features.FIRST_POT :]
    _, _, is_full, is_cooking, is_ready = pot[:5]
    if soup:
        goal = own[overcooked_features.TO_SERVING :]
    elif onion or dish or (is_full and not is_cooking and not is_ready):
        goal = pot[overcooked_features.TO_POT :]
    elif is_full:
        goal = own[overcooked_features.TO_DISHES :]
    else:
        goal = own[overcooked_features.TO_ONIONS :]
    dx, dy = goal[:2]
    closer = [direction for direction, far in enumerate((-dy, dy, dx, -dx)) if far > 0]
    if rng.random() < 0.25 or not closer:
        return rng.integers(0, 6)
    direction = rng.choice(closer)
    return INTERACT if abs(dx) + abs(dy) == 1 and own[direction] == 1 else direction
