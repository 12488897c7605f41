"""Algorithms to compare HMASD with."""
