"""Measurements of speed, memory and compile time, and the record of them.

Every benchmark runs as `python benchmarks/NAME.py` and as `python -m benchmarks.NAME`.
"""
