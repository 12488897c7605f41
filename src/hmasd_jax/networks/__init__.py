"""Network blocks with the initialization and normalization of the references."""
