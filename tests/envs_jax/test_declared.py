"""Events, places and names that environments declare, against states made by hand."""

from dataclasses import dataclass
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs_jax
from envs_jax import EnvironmentCheckError, check_environment
from envs_jax.alice_and_bob import AliceAndBob, AliceAndBobState
from envs_jax.declared import count_events, describe_agents, locate_agents, name_actions
from envs_jax.micro_battle import MicroBattle
from envs_jax.overcooked.environment import REWARD, Overcooked, OvercookedState
from envs_jax.overcooked.rules import SOUP
from envs_jax.probes import MatchCue

TRACES = Path(__file__).parents[1] / "golden" / "overcooked" / "traces.npz"
UP, DOWN, RIGHT, STAY = 2, 3, 0, 4


def alice_and_bob(positions, actions, collected=(False, False)):
    """Return the events of one step from the given (row, col) of both agents."""
    env = AliceAndBob()
    before = AliceAndBobState(jnp.array(positions), jnp.array(collected), jnp.int32(0))
    action = jnp.array(actions)
    after, _ = env.step(None, before, action)
    return {
        name: count.tolist() for name, count in count_events(env, before, action, after).items()
    }


def test_diamonds_count_for_the_agent_on_them_and_buttons_when_reached():
    counts = alice_and_bob([(2, 8), (8, 1)], (UP, STAY))  # Alice reaches the red button.
    assert counts == {
        "red diamond collected": [0, 1],
        "red button pressed": [1, 0],
        "blue diamond collected": [0, 0],
        "blue button pressed": [0, 0],
    }
    again = alice_and_bob([(1, 8), (8, 1)], (STAY, STAY), collected=(True, False))
    assert not any(map(any, again.values()))


@pytest.mark.parametrize("swapped", [False, True])
def test_events_of_recorded_kitchens_add_up(swapped):
    """Every soup earns its reward, and hands are filled and emptied by the events alone."""
    with np.load(TRACES) as file:
        prefix = "cramped_room/interact/"
        trace = {name[len(prefix) :]: x for name, x in file.items() if name.startswith(prefix)}
    env = Overcooked("cramped_room", "interact", random_seats=False)
    length = len(trace["reward"])
    counted = jnp.zeros(length, jnp.int32), jnp.full(length, swapped)

    def state(when):
        fields = (trace[f"{when}_{name}"] for name in ("pose", "held", "grid", "time"))
        return OvercookedState(*(jnp.asarray(x, jnp.int32) for x in fields), *counted)

    action = jnp.asarray(trace["action"], jnp.int32)
    action = action[:, ::-1] if swapped else action
    before, after = state("before"), state("after")
    counts = jax.vmap(lambda *step: count_events(env, *step))(before, action, after)
    counts = {name: np.asarray(count) for name, count in counts.items()}
    np.testing.assert_array_equal(counts["soup served"].sum(1) * REWARD, trace["reward"])
    assert counts["soup served"].any()
    filled = (trace["before_held"] == 0) & (trace["after_held"] != 0)
    emptied = (trace["before_held"] != 0) & (trace["after_held"] == 0)
    takes = sum(counts[k] for k in ("onion taken", "dish taken", "item taken from a counter"))
    puts = counts["onion put into a pot"] + counts["item put on a counter"]
    order = (slice(None), slice(None, None, -1 if swapped else 1))
    np.testing.assert_array_equal(takes, filled[order])
    left = emptied[order] - puts - counts["soup served"]
    thin = np.isin(trace["before_held"][order], (SOUP + 1, SOUP + 2))
    assert (left == left * thin).all()  # Soups of too few onions are served for nothing.
    assert counts["soup taken from a pot"].any()
    assert counts["pot started"].any()


def test_battles_count_attacks_damage_and_deaths():
    env = MicroBattle("3m")
    step, events = jax.jit(env.step), jax.jit(lambda *args: count_events(env, *args))
    state, _ = env.reset(jax.random.key(0))
    x = jnp.array([10.0, 10, 10, 14, 14, 14])  # Six marines in reach of each other.
    y = jnp.array([9.0, 11, 13, 9, 11, 13])
    health = jnp.array([45.0, 45, 3, 3, 45, 45])
    state = state._replace(units=state.units._replace(x=x, y=y, health=health))
    action = jnp.array([6, 6, 6])  # All attack the first enemy.
    total = {}
    for number in range(12):
        after, timestep = step(jax.random.key(number), state, action)
        for name, count in events(state, action, after).items():
            total[name] = total.get(name, 0) + np.asarray(count)
        state = after
    assert total["kill"].sum() == 1
    assert total["damage dealt"].sum() == 3  # Damage beyond the health does not count.
    assert total["death"][2] == 1
    lost = 45 + 45 + 3 - np.maximum(state.units.health[:3], 0).sum()
    np.testing.assert_allclose(total["damage taken"].sum(), lost, rtol=1e-5)
    assert (total["attack begun"] >= [1, 1, 0]).all()
    assert np.isnan(locate_agents(env, state)[2]).all()
    assert int(timestep.info["enemies_alive"]) == 2


@pytest.mark.parametrize("name", ["alice_and_bob", "overcooked", "micro_battle"])
def test_places_are_where_the_picture_shows_the_agents(name):
    env = envs_jax.make(name)
    env_state, _ = env.reset(jax.random.key(3))
    picture = env.render(env_state)
    for (x, y), (_, color) in zip(locate_agents(env, env_state), describe_agents(env)):
        # The middle may show a hat or a notch.
        around = picture[int(y) - 12 : int(y) + 12, int(x) - 12 : int(x) + 12]
        assert (np.abs(around - np.array(color, float)).sum(-1) < 60).sum() > 20


def test_an_environment_needs_no_declarations():
    env = MatchCue()
    state, _ = env.reset(jax.random.key(0))
    assert count_events(env, state, jnp.zeros(env.num_agents, int), state) == {}
    assert locate_agents(env, state) is None
    assert name_actions(env) == tuple(f"action {i}" for i in range(env.num_actions))
    assert describe_agents(env)[0] == ("agent 1", None)


@pytest.mark.parametrize(
    ("members", "message"),
    [
        ({"events": lambda self, *_: {"jump": jnp.float32(0)}}, "count 'jump' by agent"),
        ({"locate": lambda self, _: jnp.zeros((self.num_agents, 3))}, "locate must return x and y"),
        ({"action_names": ("left",)}, "action_names must have"),
        ({"agent_names": ("me",)}, "agent_names must have"),
    ],
)
def test_wrong_declarations_are_named(members, message):
    declared = dataclass(frozen=True)(type("Declared", (MatchCue,), members))
    with pytest.raises(EnvironmentCheckError, match=message):
        check_environment(declared())
