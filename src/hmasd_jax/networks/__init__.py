"""Networks, with the initialization and normalization of MAPPO and MAT."""
