"""Settings to vary, as NAME=VALUE,VALUE on a command line."""

from collections.abc import Sequence

from hmasd_jax.validation import ConfigError


def split_settings(varied: Sequence[str]) -> list[tuple[str, list[str]]]:
    """Return the dotted name and the values of each NAME=VALUE,VALUE.

    Raises:
        ConfigError: One is not of this form, or two name the same setting.
    """
    settings = [split_vary(vary) for vary in varied]
    names = [name for name, _ in settings]
    for name in names:
        if names.count(name) > 1:
            raise ConfigError(f"--vary names {name} twice: give all its values at once")
    return settings


def split_vary(vary: str) -> tuple[str, list[str]]:
    """Return the dotted name and the values of NAME=VALUE,VALUE.

    Raises:
        ConfigError: `vary` is not of this form, or names a value twice.
    """
    name, equals, values = vary.partition("=")
    found = [value.strip() for value in values.split(",")]
    if not (name and equals and all(found)) or len(set(found)) < len(found):
        raise ConfigError(
            "--vary must name a setting and its values, each once, as in "
            f"algorithm.skill_interval=5,10,25: got {vary!r}"
        )
    return name.strip().replace("-", "_"), found
