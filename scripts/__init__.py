"""Programs that record results."""
