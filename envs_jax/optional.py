"""Packages that only the adapters need."""

import importlib
from types import ModuleType


class MissingPackageError(ImportError, ValueError):
    """An optional package is not installed; the message is one line with the remedy."""


def require(package: str, extra: str, purpose: str) -> ModuleType:
    """Import an optional package.

    Args:
        package: name to import.
        extra: extra of this project that installs it.
        purpose: what needs it, the beginning of the message.

    Raises:
        MissingPackageError: it is not installed.
    """
    try:
        return importlib.import_module(package)
    except ModuleNotFoundError as error:
        if error.name != package:  # installed, and one of its own is missing
            raise
        raise MissingPackageError(
            f"{purpose} needs the package {package}: pip install 'hmasd-jax[{extra}]'"
        ) from error
