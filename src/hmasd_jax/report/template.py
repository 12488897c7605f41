"""Templates of the pages, and how they write numbers."""

import shlex
from typing import TYPE_CHECKING

import numpy as np

from hmasd_jax.analysis.statistics import Estimate

if TYPE_CHECKING:
    from jinja2 import Template


def load_template(name: str) -> "Template":
    """Return a template of the page."""
    from jinja2 import Environment, PackageLoader, StrictUndefined
    from markupsafe import Markup

    environment = Environment(
        loader=PackageLoader("hmasd_jax.report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {
        "estimate": write_estimate,
        "percent": write_percent,
        "reached": write_reached,
        "html": Markup,
        "shell": shlex.join,
    }
    return environment.get_template(name)


def write_reached(reached: list[tuple[int, float]]) -> str:
    """Write the median and the range of when seeds first reached the threshold."""
    if not reached:
        return "never"
    steps, seconds = np.array(reached, float).T
    text = f"{np.median(steps):,.0f} env steps, {np.median(seconds):,.0f} s"
    if len(steps) > 1:
        text += f" (median of {len(steps)}; {steps.min():,.0f} to {steps.max():,.0f} env steps)"
    return text


def write_estimate(value: Estimate) -> str:
    """Write a number with its interval, which one sample does not have."""
    if value.low == value.high:
        return f"{value.value:.3g}"
    return f"{value.value:.3g} [{value.low:.3g}, {value.high:.3g}]"


def write_percent(value: Estimate) -> str:
    """Write a share with its interval in percent."""
    return f"{value.value:.0%} [{value.low:.0%}, {value.high:.0%}]"
