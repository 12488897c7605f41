"""HMASD and its baselines as jitted JAX training steps."""
