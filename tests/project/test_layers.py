"""Imports point downwards only, from the command line to the types, and never in a circle."""

import ast
from graphlib import TopologicalSorter
from importlib.util import resolve_name
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
SOURCES = {"hmasd_jax": ROOT / "src" / "hmasd_jax", "envs_jax": ROOT / "envs_jax"}
LAYERS = (
    {"envs_jax"},
    {"types", "validation"},
    {"rl"},
    {"networks"},
    {"exploration"},
    {"hmasd", "baselines"},
    {"algorithms"},
    {"config"},
    {"runs"},
    {"training"},
    {"analysis"},
    {"search"},
    {"report"},
    {"cli"},
    {"train"},
)
"""Rooms from the lowest to the highest. docs/guides/architecture.md explains them."""
RANK = {room: rank for rank, rooms in enumerate(LAYERS) for room in rooms}
FACADE = "hmasd_jax"
"""Offers functions of the rooms to users, so that it may import from all of them."""


def modules():
    """Map the dotted name of every module to its file."""
    found = {}
    for package, folder in SOURCES.items():
        for path in folder.rglob("*.py"):
            parts = path.relative_to(folder).with_suffix("").parts
            parts = parts[:-1] if parts[-1] == "__init__" else parts
            found[".".join((package, *parts))] = path
    return found


MODULES = modules()


def imports(source, package):
    """List the modules of this project that a module of `package` imports, at any depth."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = resolve_name("." * node.level + (node.module or ""), package)
            names = [f"{base}.{alias.name}" for alias in node.names]
            names = [name if name in MODULES else base for name in names]
        else:
            continue
        yield from (name for name in names if name in MODULES)


def room(module):
    package, *rest = module.split(".")
    return rest[0] if package == "hmasd_jax" and rest else package


def package(module):
    return module if MODULES[module].stem == "__init__" else module.rpartition(".")[0]


GRAPH = {name: set(imports(path.read_text(), package(name))) for name, path in MODULES.items()}


def upward(graph):
    """List imports of a higher room, or of another room of the same layer."""
    return [
        (module, imported)
        for module in graph.keys() - {FACADE}
        for imported in graph[module]
        if room(imported) != room(module)
        and (imported == FACADE or RANK[room(imported)] >= RANK[room(module)])
    ]


def test_every_room_has_its_layer():
    assert {room(module) for module in MODULES} - {FACADE} == RANK.keys()


def test_no_import_points_upwards():
    assert upward(GRAPH) == []


def test_no_modules_import_each_other_in_a_circle():
    TopologicalSorter(GRAPH).prepare()  # raises CycleError


@pytest.mark.parametrize(
    ("module", "imported", "is_upward"),
    [
        ("envs_jax.check", "hmasd_jax.types", True),
        ("hmasd_jax.rl.gae", "hmasd_jax.networks.gru", True),
        ("hmasd_jax.hmasd.algorithm", "hmasd_jax.baselines.mappo", True),
        ("hmasd_jax.runs.load", "hmasd_jax", True),
        ("hmasd_jax.networks.gru", "hmasd_jax.rl.gae", False),
        ("hmasd_jax.rl.sgd", "hmasd_jax.rl.gae", False),
    ],
)
def test_an_arrow_upwards_is_found(module, imported, is_upward):
    assert bool(upward({module: {imported}})) == is_upward


@pytest.mark.parametrize(
    ("line", "imported"),
    [
        ("import hmasd_jax.training.loop as loop", "hmasd_jax.training.loop"),
        ("from hmasd_jax.training import loop", "hmasd_jax.training.loop"),
        ("from hmasd_jax.training.loop import train_seeds", "hmasd_jax.training.loop"),
        ("from ..training import loop", "hmasd_jax.training.loop"),
        ("from . import gae", "hmasd_jax.rl.gae"),
        ("def f():\n    from hmasd_jax import training", "hmasd_jax.training"),
        ("import jax", None),
    ],
)
def test_every_form_of_import_is_found(line, imported):
    assert list(imports(line, "hmasd_jax.rl")) == ([imported] if imported else [])
