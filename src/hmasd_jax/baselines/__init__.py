"""Algorithms that HMASD is compared with."""
