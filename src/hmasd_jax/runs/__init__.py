"""Files of a run: its folder, metrics and checkpoints, and functions that load them."""
