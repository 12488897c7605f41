"""Search of settings: its space, its trials in Optuna's storage, and their scores."""
