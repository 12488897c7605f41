"""Programs that play, measure and record; each runs as `python scripts/NAME.py` from the root."""
