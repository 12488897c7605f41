"""Frames of an episode: the environment's picture with the skills in use below it.

The border of the picture has the color of the team skill Z. The label of each agent has the color
of its individual skill z^i. An environment may have `agent_names`, and `agent_colors` (RGB), which
are drawn as a dot on the label.
"""

from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from envs_jax.declared import Agent
from hmasd_jax.analysis.colors import OKABE_ITO

SKILL_COLORS = (*OKABE_ITO, "#7F7F7F")
TEAM_COLORS = ("#4B3F8F", "#A8820A", "#2D6A6A", "#8C2F39", "#3D5A1E", "#6B4226", "#1F1F1F")
INK, FAINT, PAPER = "#1E1E1E", "#808080", "#FFFFFF"
WON, LOST = "#1B7F3B", "#B3261E"

BORDER = 6
MIN_WIDTH = 320
"""Narrower pictures are enlarged by a whole factor, so that the caption fits (pixels)."""
FONT_SIZE = 14
LINE = 24
"""Height of a line of the caption (pixels)."""


class Chip(NamedTuple):
    """Label of the team or of an agent with its skill."""

    label: str
    color: str
    """Color of the skill."""
    dot: tuple[int, int, int] | None
    """Color of the agent, RGB."""
    left: float
    """Left edge (pixels)."""
    right: float
    """Right edge (pixels)."""


def draw_frame(
    picture: np.ndarray,
    texts: tuple[str, str],
    color: str,
    skills: np.ndarray | None,
    agents: Sequence[Agent],
) -> np.ndarray:
    """Draw one frame.

    Args:
        picture: Picture of the environment, (height, width, 3), uint8.
        texts: Texts below the picture, on the left and on the right.
        color: Color of the left text.
        skills: (Z, z^1, .., z^N), or None for policies without skills.
        agents: Names and colors of the agents.

    Returns:
        The frame, (height, width, 3), uint8. The picture has a border in the color of Z, and the
        caption has one label per skill.
    """
    from PIL import Image, ImageDraw

    factor = -(-MIN_WIDTH // picture.shape[1])
    picture = picture.repeat(factor, 0).repeat(factor, 1)
    height, width = picture.shape[0] + 2 * BORDER, picture.shape[1] + 2 * BORDER
    rows = _arrange(skills, agents, width)
    total = height + LINE * (1 + len(rows)) + BORDER
    # Video formats require even sizes.
    image = Image.new("RGB", (width + width % 2, total + total % 2), PAPER)
    draw = ImageDraw.Draw(image)
    edge = INK if skills is None else TEAM_COLORS[skills[0] % len(TEAM_COLORS)]
    draw.rectangle((0, 0, width - 1, height - 1), fill=edge)
    image.paste(Image.fromarray(picture), (BORDER, BORDER))
    middle = height + LINE / 2
    draw.text((BORDER, middle), texts[0], color, _font(), anchor="lm")
    draw.text((width - BORDER, middle), texts[1], FAINT, _font(), anchor="rm")
    for row, chips in enumerate(rows):
        top = height + LINE * (1 + row)
        for label, fill, dot, left, right in chips:
            draw.rounded_rectangle((left, top + 2, right, top + LINE - 2), 5, fill=fill)
            draw.text((right - 6, top + LINE / 2), label, PAPER, _font(), anchor="rm")
            if dot is not None:
                draw.circle((left + 12, top + LINE / 2), 6, dot, PAPER)
    return np.asarray(image)


def shrink(picture: np.ndarray, max_width: int | None) -> np.ndarray:
    """Scale an image (height, width, 3) down to at most `max_width` pixels."""
    from PIL import Image

    height, width = picture.shape[:2]
    if max_width is None or width <= max_width:
        return picture
    size = (max_width, round(height * max_width / width))
    return np.asarray(Image.fromarray(picture).resize(size, Image.Resampling.LANCZOS))


def fill_up(frames: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Extend frames (height, width, 3) to one size, with white on the right and below."""
    height, width = np.max([frame.shape[:2] for frame in frames], axis=0)
    sizes = [((0, height - len(f)), (0, width - f.shape[1]), (0, 0)) for f in frames]
    return [np.pad(f, size, constant_values=255) for f, size in zip(frames, sizes)]


def _arrange(skills: np.ndarray | None, agents: Sequence[Agent], width: int) -> list[list[Chip]]:
    """Arrange the labels in rows, as many as fit in each row."""
    if skills is None:
        return []
    rows: list[list[Chip]] = [[]]
    left = float(BORDER)
    for token, skill in enumerate(map(int, skills)):
        colors = SKILL_COLORS if token else TEAM_COLORS
        name, dot = agents[token - 1] if token else ("team", None)
        label = f"{name} {'z' if token else 'Z'} = {skill}"
        size = _font().getlength(label) + (12 if dot is None else 28)
        if left + size > width - BORDER and rows[-1]:
            rows.append([])
            left = float(BORDER)
        rows[-1].append(Chip(label, colors[skill % len(colors)], dot, left, left + size))
        left += size + 6
    return rows


@lru_cache
def _font():
    """Return the sans-serif font that comes with matplotlib, the same on every machine."""
    import matplotlib
    from PIL import ImageFont

    return ImageFont.truetype(f"{matplotlib.get_data_path()}/fonts/ttf/DejaVuSans.ttf", FONT_SIZE)
