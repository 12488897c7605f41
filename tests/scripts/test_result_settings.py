"""Records are compared with the presets that their commands name."""

import json

from scripts.records import RESULTS
from scripts.result_settings import changed_settings, pays_otherwise, preset_of


def _record(name):
    return json.loads((RESULTS / f"{name}.json").read_text())


def test_a_changed_preset_is_noticed():
    record = _record("micro_battle/3m/tried/hmasd_wrapper_state")
    assert changed_settings(record) == {"env.state": ("mappo", "smac")}


def test_options_of_the_command_are_noticed():
    record = _record("overcooked/cramped_room/hmasd_lambda_095")
    assert preset_of(record).stem == "hmasd_robust"
    assert changed_settings(record) == {"algorithm.ppo.gae_lambda": (0.95, 0.99)}


def test_former_settings_and_other_words_for_the_same_are_no_differences():
    record = _record("alice_and_bob/nohigh")
    assert "discriminator_standardize" in record["config"]["algorithm"]
    assert changed_settings(record) == {}
    record = _record("micro_battle/3m/hmasd_robust")
    assert "state" not in record["config"]["env"]
    assert changed_settings(record) == {}


def test_seeds_steps_and_checkpoints_are_no_differences():
    record = _record("alice_and_bob/hmasd_robust_fresh")
    changed = record["config"] | {
        "total_env_steps": 9_000_000,
        "num_seeds": 1,
        "seed": 7,
        "checkpoint_interval": 400_000,
    }
    assert changed_settings(record | {"config": changed}) == {}


def test_a_bonus_that_pays_otherwise_than_todays_is_noticed():
    record = _record("micro_battle/2s_vs_1sc/hmasd_general_per_value")
    assert pays_otherwise(record)
    assert pays_otherwise(record | {"started": "2026-11-29T23:31:59+0000"})
    assert not pays_otherwise(record | {"started": "2026-11-29T23:32:00+0000"})
    assert not pays_otherwise(_record("micro_battle/2s_vs_1sc/hmasd_general"))
    assert not pays_otherwise(_record("micro_battle/2s_vs_1sc/hmasd"))


def test_settings_without_an_effect_are_no_differences():
    """No battle of 3m is as long as a period, and none returns more than 1, which pairs await."""
    battle = _record("micro_battle/3m/hmasd_general_rarest")
    assert (
        not {"period", "patience", "pair_coef"} & battle["config"]["algorithm"]["frontier"].keys()
    )
    assert changed_settings(battle) == {}
    kitchen = _record("overcooked/asymmetric_advantages/hmasd_general_by_agent")
    changed = changed_settings(kitchen)
    assert changed["algorithm.frontier.period"] == (0, 200)
    assert changed["algorithm.frontier.patience"] == (0, 100)
    assert changed["algorithm.frontier.pair_coef"] == (0, 0.1)
