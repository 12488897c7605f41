"""Reinforcement learning that every algorithm shares: PPO, advantages, rollouts, evaluation."""
