"""Learning curves, statistics and pictures of finished or running runs."""
