"""Import of optional packages, which only the adapters need."""

import importlib
from types import ModuleType


class MissingPackageError(ImportError, ValueError):
    """An optional package is not installed. The message is one line that names the remedy."""


def require(package: str, extra: str, purpose: str) -> ModuleType:
    """Import an optional package.

    Args:
        package: Name to import.
        extra: Extra of this project that installs the package.
        purpose: Caller that needs the package, the first words of the error message.

    Raises:
        MissingPackageError: The package is not installed.
    """
    try:
        return importlib.import_module(package)
    except ModuleNotFoundError as error:
        if error.name != package:  # It is installed, but one of its dependencies is not.
            raise
        raise MissingPackageError(
            f"{purpose} needs the package {package}: "
            f"uv pip install -c constraints.txt -e '.[{extra}]'"
        ) from error
