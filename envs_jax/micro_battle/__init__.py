"""Unit micro-battles: a substitute for SMAC's 3m, 2s_vs_1sc and 2m_vs_1z with 0-1 reward."""

from envs_jax.micro_battle.environment import MicroBattle, MicroBattleState
from envs_jax.micro_battle.scenarios import SCENARIOS, Scenario, Spawn

__all__ = ["SCENARIOS", "MicroBattle", "MicroBattleState", "Scenario", "Spawn"]
