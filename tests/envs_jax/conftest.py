"""Access to the original Overcooked, from the folder of recorded data."""

import importlib.util
from pathlib import Path

import pytest

GOLDEN = Path(__file__).parents[1] / "golden" / "overcooked"


@pytest.fixture(scope="session")
def overcooked_oracle():
    """Import the module tests/golden/overcooked/oracle.py."""
    spec = importlib.util.spec_from_file_location("overcooked_oracle", GOLDEN / "oracle.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module
