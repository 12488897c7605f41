"""Comments in the shipped presets, and the features that their indices stand for."""

import dataclasses
import json
import re
from pathlib import Path

import numpy as np
import pytest

from envs_jax.overcooked import features
from envs_jax.overcooked.environment import REWARD, Overcooked
from hmasd_jax.baselines.eiti.config import EDTIConfig, EITIConfig, LocalStateConfig
from hmasd_jax.baselines.qmix.config import MASERConfig, QLearningConfig
from hmasd_jax.config import from_json, identity, load, to_json
from hmasd_jax.config.presets import find_preset
from hmasd_jax.rl.ppo import PPOConfig

CONFIGS = Path(__file__).parents[2] / "configs"


@pytest.mark.parametrize("name", ["hmasd_general", "mappo_general"])
def test_the_general_presets_have_the_same_settings_of_the_algorithm_in_all_tasks(name):
    paths = sorted(CONFIGS.glob(f"**/{name}.toml"))
    assert len(paths) == 7
    assert len({load(path).algorithm for path in paths}) == 1


def test_mappo_has_the_exploration_parts_of_the_general_preset():
    """Its reward is the team's, which HMASD's low level sees multiplied by lambda_e."""
    general, mappo = (
        load(CONFIGS / f"alice_and_bob/{x}_general.toml").algorithm for x in ("hmasd", "mappo")
    )
    assert (mappo.ppo, mappo.imitation) == (general.ppo, general.imitation)
    assert mappo.entropy_coef == general.low_entropy_coef
    assert mappo.solved.step_factor == general.solved.step_factor
    assert mappo.solved.sharpening == general.solved.sharpening
    coef = general.frontier.coef / general.extrinsic_coef
    assert mappo.frontier == dataclasses.replace(general.frontier, coef=coef)


def test_the_quick_sweep_runs_the_general_preset():
    quick, general = (load(CONFIGS / f"alice_and_bob/{x}.toml") for x in ("quick", "hmasd_general"))
    assert (quick.env, quick.algorithm) == (general.env, general.algorithm)


@pytest.mark.parametrize(
    "path", sorted(CONFIGS.glob("**/hmasd_general.toml")), ids=lambda path: path.parent.name
)
def test_the_general_preset_plays_the_papers_environment_and_gives_no_hint(path):
    config = load(path)
    env = load(path.with_name("hmasd.toml")).env
    if isinstance(env, Overcooked):
        # A bonus for single features must tell the pots apart. Observations are the paper's.
        env = dataclasses.replace(env, state="kitchen")
    assert config.env == env
    assert config.algorithm.discriminator_obs == ()


@pytest.mark.parametrize(
    ("name", "preset"),
    [
        ("alice_and_bob/hmasd_general", "alice_and_bob/hmasd"),
        ("micro_battle/3m/hmasd_general", "micro_battle/3m/hmasd"),
        ("overcooked/coordination_ring/mat", "overcooked/coordination_ring/mat"),
    ],
)
def test_a_run_is_compared_with_the_papers_preset(name, preset):
    table = to_json(load(CONFIGS / f"{name}.toml"))
    found = find_preset(table)
    assert found is not None
    assert found[0] == preset
    assert found[1]["algorithm.ppo.discount"] == 0.99


def test_another_task_has_no_preset():
    table = to_json(load(None, {"env.name": "micro_battle", "env.scenario": "3m"}))
    assert find_preset(table | {"env": table["env"] | {"scenario": "mine"}}) is None
    assert find_preset(table | {"algorithm": {"name": "mine"}}) is None


@pytest.mark.parametrize(
    "path", sorted(CONFIGS.glob("**/no*.toml")), ids=lambda path: f"{path.parent.name}-{path.stem}"
)
def test_an_ablation_is_the_papers_preset_but_for_marked_lines(path):
    """A marked line says what is there in hmasd.toml."""
    ablated, full = (identity(to_json(load(p))) for p in (path, path.with_name("hmasd.toml")))
    changed = {
        name.removeprefix("algorithm."): value
        for name, value in full.items()
        if ablated[name] != value
    }
    marked = re.findall(r"^(\w+) = .*# not ([\w.\"]+)", path.read_text(), re.MULTILINE)
    assert {name: json.loads(value) for name, value in marked} == changed


@pytest.mark.parametrize("name", ["hmasd", "mappo", "mat"])
@pytest.mark.parametrize(
    ("scenario", "sizes"), [("3m", (64, 48)), ("2s_vs_1sc", (37, 27)), ("2m_vs_1z", (36, 26))]
)
def test_the_papers_battles_have_the_sizes_of_the_authors_code(name, scenario, sizes):
    env = load(CONFIGS / f"micro_battle/{scenario}/{name}.toml").env
    assert (env.obs_dim, env.state_dim) == sizes


def test_battles_recorded_before_the_state_had_its_own_format_keep_theirs():
    files = (CONFIGS.parent / "results/micro_battle").rglob("*.json")
    results = [json.loads(path.read_text()) for path in files]
    tables = [result["config"]["env"] for result in results if "config" in result]
    tables = [table for table in tables if "state" not in table]
    assert tables
    for table in tables:
        env = from_json({"env": table}).env
        assert env.state_dim == {"3m": 75, "2s_vs_1sc": 34, "2m_vs_1z": 33}[env.scenario]


PYMARL = ("maser", "qmix", "vdn")
INFLUENCE = ("eiti", "edti")
OWN_TO_A_TASK = {"rollout_length", "gradient_steps"}


@pytest.mark.parametrize(
    "path", sorted(CONFIGS.glob("**/maser.toml")), ids=lambda path: path.parent.name
)
def test_presets_with_replay_mark_what_is_not_pymarls(path):
    configs = [load(path.with_name(f"{name}.toml")) for name in PYMARL]
    assert len({config.algorithm.q_learning for config in configs}) == 1
    assert len({config.env for config in configs}) == 1
    settings = dataclasses.asdict(configs[0].algorithm.q_learning)
    pymarls = dataclasses.asdict(QLearningConfig(num_envs=1))
    changed = {name for name, value in settings.items() if value != pymarls[name]}
    marked = re.findall(r"^(\w+) = .*  # not ", path.read_text(), re.MULTILINE)
    assert set(marked) - OWN_TO_A_TASK == changed - OWN_TO_A_TASK
    assert configs[0].algorithm == MASERConfig(q_learning=configs[0].algorithm.q_learning)
    assert settings["rollout_length"] == configs[0].env.max_steps


def test_all_algorithms_have_a_preset_for_every_task_and_the_same_budget():
    papers = sorted(CONFIGS.glob("**/hmasd.toml"))
    assert len(papers) == 7
    for path in papers:
        names = ("mappo", "ippo", "mat", *PYMARL)
        for name in names + (INFLUENCE if "overcooked" in path.parts else ()):
            config, of_paper = load(path.with_name(f"{name}.toml")), load(path)
            assert config.total_env_steps == of_paper.total_env_steps
            assert config.eval_interval == of_paper.eval_interval
            assert config.eval_episodes == of_paper.eval_episodes
            tables = [dataclasses.asdict(c.env) for c in (config, of_paper)]
            for table in tables:
                table.pop("observation"), table.pop("state", None)
            assert tables[0] == tables[1]


@pytest.mark.parametrize(
    "path", sorted(CONFIGS.glob("**/eiti.toml")), ids=lambda path: path.parent.name
)
def test_presets_with_influence_scale_the_authors_weights_to_the_reward(path):
    eiti, edti, ippo = (load(path.with_name(f"{name}.toml")) for name in (*INFLUENCE, "ippo"))
    assert eiti.algorithm.ppo == edti.algorithm.ppo == ippo.algorithm.ppo
    assert eiti.algorithm.local_state == edti.algorithm.local_state
    scale = REWARD / 1000  # rewards of the authors' tasks
    defaults = EITIConfig(), EDTIConfig()
    for config, default in zip((eiti.algorithm, edti.algorithm), defaults):
        assert config.curiosity_coef == pytest.approx(10 * scale)
        assert default.curiosity_coef == pytest.approx(10 / 1000)
    assert eiti.algorithm.influence_coef == pytest.approx(scale)
    # The other weights of EDTI have no unit, and are those of the defaults.
    scaled = {"curiosity_coef": 0.01, "local_state": LocalStateConfig(), "ppo": PPOConfig()}
    assert dataclasses.replace(edti.algorithm, **scaled) == EDTIConfig()


def test_local_states_of_overcooked_are_cell_orientation_item_and_pots():
    config = load(CONFIGS / "overcooked/cramped_room/eiti.toml")
    chosen = config.algorithm.local_state.features
    pot = np.arange(1, 6)  # is empty, full, cooking, ready; onions
    own = [*range(features.TO_ONIONS), features.SOUP_ONIONS]
    pots = [features.FIRST_POT + place * features.POT_FEATURES + pot for place in range(2)]
    assert list(chosen) == [*own, *np.concatenate(pots), *range(features.XY.start, 96)]


def test_presets_are_found_from_any_folder(tmp_path, monkeypatch):
    preset = load("configs/alice_and_bob/quick.toml")
    monkeypatch.chdir(tmp_path)
    assert load("configs/alice_and_bob/quick.toml") == preset
    own = tmp_path / "configs" / "alice_and_bob" / "quick.toml"
    own.parent.mkdir(parents=True)
    own.write_text("seed = 5")
    assert load("configs/alice_and_bob/quick.toml").seed == 5
