"""Files of a run: its folder, metrics, checkpoints, and how to load them."""
