"""Any value in any place is either usable or refused in one short line, at once.

`pytest tests/config/test_fuzz.py --hypothesis-profile long` tries 5,000 times per test.
"""

import json

import jax
from hypothesis import given
from hypothesis import strategies as st

from envs_jax.micro_battle.environment import MicroBattle
from envs_jax.micro_battle.scenarios import Scenario, Spawn
from envs_jax.overcooked import Overcooked
from envs_jax.registry import ENVIRONMENTS
from hmasd_jax.config import ConfigError, build, from_json, load, to_json
from hmasd_jax.config.from_table import Text
from hmasd_jax.runs import metrics_log
from hmasd_jax.runs.folder import seeds_of
from hmasd_jax.training.schedule import make_plan
from hmasd_jax.validation import LARGEST

ENVS = [name for name in ENVIRONMENTS if name != "jaxmarl"]  # It needs an optional package.


def flatten(table, prefix=""):
    """Yield the dotted name and the value of every setting in nested tables."""
    for name, value in table.items():
        yield prefix + name, value
        if isinstance(value, dict):
            yield from flatten(value, f"{prefix}{name}.")


TABLES = [
    to_json(load(None, {"env.name": env, "algorithm.name": algorithm}))
    for env in ENVS
    for algorithm in ("hmasd", "mappo", "mat")
]
NAMES = sorted({name for table in TABLES for name, _ in flatten(table)})

numbers = st.one_of(
    st.integers(-3, 200),
    st.integers(),
    st.sampled_from([2**31 - 1, 2**31, 2**32, 2**62, 2**63, 10**30, 10**400, -(10**400)]),
    st.floats(),
    st.sampled_from([1e30, 1e12, 0.5, -0.0]),
)
plain = st.one_of(
    numbers,
    st.booleans(),
    st.none(),
    st.text(max_size=20),
    st.sampled_from(["none", "nan", "hmasd", "3m", "\n", "#", "1\nseed = 3", "x" * 10_000]),
)
values = st.recursive(
    plain,
    lambda inner: st.one_of(
        st.lists(inner, max_size=4),
        st.dictionaries(st.one_of(st.sampled_from(["name", "x"]), st.text(max_size=5)), inner),
    ),
    max_leaves=6,
)
typed = st.one_of(
    st.text(max_size=30),
    values.map(str),
    numbers.map(str),
    st.sampled_from(["[" * 2000, "1" * 400, "0x" + "f" * 5000, "1 #", "1,", "1_0", "+1", "1e5"]),
)


def assert_short(error):
    assert "\n" not in str(error)
    assert len(str(error)) < 2000


def assert_usable_or_refused(make):
    """Build all that a run builds before it compiles."""
    try:
        config = make()
        build(config)
    except ConfigError as error:
        assert_short(error)
        return
    plan = make_plan(config)
    assert plan.num_updates <= LARGEST
    assert plan.eval_every % plan.log_every == 0
    assert from_json(to_json(config)) == config
    json.dumps(to_json(config), allow_nan=False)


@given(st.sampled_from(ENVS), st.dictionaries(st.sampled_from(NAMES), values, max_size=3))
def test_any_setting(env, overrides):
    assert_usable_or_refused(lambda: load(None, {"env.name": env, **overrides}))


@given(
    st.sampled_from(ENVS), st.dictionaries(st.sampled_from(NAMES), typed, min_size=1, max_size=2)
)
def test_any_typed_setting(env, words):
    overrides = {name: Text(value) for name, value in words.items()}
    assert_usable_or_refused(lambda: load(None, {"env.name": env, **overrides}))


@given(st.sampled_from(TABLES), st.data())
def test_any_damage_to_a_configuration_file(tmp_path_factory, table, data):
    path = tmp_path_factory.getbasetemp() / "fuzz.json"
    path.write_bytes(damage(json.dumps(table, indent=2).encode(), data))
    assert_usable_or_refused(lambda: load(path))
    toml = path.with_suffix(".toml")
    toml.write_bytes(damage(b'seed = 3\n[env]\nname = "alice_and_bob"\nmax_steps = 30\n', data))
    assert_usable_or_refused(lambda: load(toml))


def damage(whole, data):
    """Cut bytes out of a file and put others in."""
    start, stop = sorted(data.draw(st.tuples(*[st.integers(0, len(whole))] * 2)))
    pieces = [b"", b"\n", b"\xff", b"[]", b"null", b"{}", b"3", b"[" * 3000, b"1" * 400, b"NaN"]
    inserted = data.draw(st.one_of(st.sampled_from(pieces), st.binary(max_size=8)))
    return whole[:start] + inserted + whole[stop:]


RECORDS = [
    {"kind": kind, "seed": 0, "env_steps": step, "wall_seconds": 1.5, "success": 0.5}
    for step in range(0, 500, 100)
    for kind in ("train", "eval")
]


@given(st.data())
def test_any_damage_to_the_files_of_a_run(tmp_path_factory, data):
    """Check that no record outside the damage is lost, and that no line is."""
    run = tmp_path_factory.getbasetemp() / "fuzz"
    path = run / "seed_0" / "metrics.jsonl"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.with_name(metrics_log.REMOVED).unlink(missing_ok=True)
    lines = [json.dumps(record) for record in RECORDS]
    whole = "".join(line + "\n" for line in lines).encode()
    damaged = damage(whole, data)
    path.write_bytes(damaged)
    untouched = [line for line in damaged.decode(errors="replace").split("\n") if line in lines]
    records = metrics_log.read(path)
    for line in untouched:
        assert json.loads(line) in records
    metrics_log.keep_until(path, 200)
    kept = metrics_log.read(path)
    assert all(record["env_steps"] <= 200 for record in kept)
    assert [record for record in records if record["env_steps"] <= 200] == kept
    removed = path.with_name(metrics_log.REMOVED)
    left = path.read_bytes() + (removed.read_bytes() if removed.exists() else b"")
    assert set(damaged.split(b"\n")) - {b""} <= set(left.split(b"\n"))
    log = metrics_log.JsonLines(path)
    log.write(RECORDS[-1])
    log.close()
    assert metrics_log.read(path) == [*kept, RECORDS[-1]]
    assert seeds_of(run) == [0]


coordinates = st.one_of(st.integers(-2, 34).map(float), st.floats())
spawns = st.builds(
    Spawn, st.sampled_from(["marine", "zealot", "spine_crawler", ""]), *[coordinates] * 2
)
rectangles = st.one_of(
    st.just((0, 0, 32, 32)), st.tuples(*[st.one_of(st.integers(-2, 34), st.integers())] * 4)
)


@given(
    st.lists(spawns, max_size=3).map(tuple),
    st.lists(spawns, max_size=3).map(tuple),
    st.lists(rectangles, max_size=2).map(tuple),
    st.lists(st.tuples(coordinates, coordinates), max_size=3).map(tuple),
    st.one_of(st.just((32, 32)), st.tuples(st.integers(), st.integers()), st.just(())),
)
def test_any_scenario(allies, enemies, floor, goals, size):
    try:
        env = MicroBattle(Scenario(allies, enemies, floor, goals, size=size))
    except ValueError as error:
        assert_short(error)
        return
    jax.eval_shape(env.reset, jax.random.key(0))


@given(st.lists(st.text("XOPDS 12", min_size=3, max_size=6), min_size=3, max_size=5), st.booleans())
def test_any_kitchen(rows, close):
    if close:  # Random kitchens are hardly ever closed.
        width = min(map(len, rows))
        rows = ["X" * (width + 2), *(f"O{row[:width]}S" for row in rows), "P" * width + "DX"]
    try:
        env = Overcooked("\n".join(rows))
    except ValueError as error:
        assert_short(error)
        return
    jax.eval_shape(env.reset, jax.random.key(0))
