"""Pictures of JaxMARL's environments, drawn on the host without opening a window."""

from collections.abc import Callable
from typing import Any

import jax
import numpy as np

SIDE = 320  # Pixels.
BACKGROUND, ALLY, ENEMY, LANDMARK = (244, 241, 232), (58, 104, 196), (206, 64, 64), (120, 124, 134)


def draw(source: Any, state: Any) -> np.ndarray:
    """Draw `state` of the environment `source` as a uint8 image (height, width, 3)."""
    for cls in type(source).__mro__:
        if cls.__name__ in PICTURES:
            return PICTURES[cls.__name__](source, state)
    return draw_numbers(state)


def draw_numbers(state: Any) -> np.ndarray:
    """Draw each number of any state as a gray column, from the least (black) to the greatest."""
    leaves = [np.asarray(leaf, np.float32).ravel() for leaf in _numbers(state)]
    values = np.nan_to_num(np.concatenate(leaves))
    low, high = values.min(), values.max()
    gray = np.round(255 * (values - low) / max(high - low, 1e-6)).astype(np.uint8)
    width = max(1, SIDE // len(gray))
    return np.repeat(np.tile(gray, (32, 1))[..., None], 3, axis=-1).repeat(width, axis=1)


def _numbers(state: Any) -> list[Any]:
    """Return the leaves that are numbers, without random keys."""
    leaves = jax.tree.leaves(state)
    return [leaf for leaf in leaves if not jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.prng_key)]


def _draw_overcooked(source: Any, state: Any) -> np.ndarray:
    """Draw a kitchen by JaxMARL's own visualizer."""
    from jaxmarl.viz.overcooked_visualizer import OvercookedVisualizer

    padding = source.agent_view_size - 2
    return OvercookedVisualizer._render_grid(
        np.asarray(state.maze_map)[padding:-padding, padding:-padding],
        agent_dir_idx=np.asarray(state.agent_dir_idx),
        agent_inv=np.asarray(state.agent_inv),
    )


def _draw_smax(source: Any, state: Any) -> np.ndarray:
    """Draw living units as discs."""
    units = state.state
    size = np.array([source.map_width, source.map_height])
    types = np.asarray(units.unit_types)
    return _draw_discs(
        np.asarray(units.unit_positions) / size,
        np.asarray(source.unit_type_radiuses)[types] / size[0],
        np.where(np.asarray(units.unit_teams)[:, None] == 0, ALLY, ENEMY),
        np.asarray(units.unit_alive),
    )


def _draw_mpe(source: Any, state: Any) -> np.ndarray:
    """Draw agents and landmarks on the square from -1.5 to 1.5. Those outside are not shown."""
    extent = 1.5
    colors = [ALLY] * source.num_agents + [LANDMARK] * source.num_landmarks
    return _draw_discs(
        (np.asarray(state.p_pos) / extent + 1) / 2,
        np.asarray(source.rad) / (2 * extent),
        np.array(colors),
        np.ones(source.num_entities, bool),
    )


def _draw_discs(
    centers: np.ndarray, radii: np.ndarray, colors: np.ndarray, shown: np.ndarray
) -> np.ndarray:
    """Draw discs on the unit square, with y upwards.

    Args:
        centers: x and y, (discs, 2).
        radii: Radii, (discs,).
        colors: Colors in 0..255, (discs, 3).
        shown: True for each disc to draw, (discs,).
    """
    image = np.full((SIDE, SIDE, 3), BACKGROUND, np.uint8)
    y, x = (np.mgrid[:SIDE, :SIDE] + 0.5) / SIDE
    for center, radius, color in zip(centers[shown], radii[shown], colors[shown]):
        image[np.hypot(x - center[0], 1 - y - center[1]) < radius] = color
    return image


PICTURES: dict[str, Callable[[Any, Any], np.ndarray]] = {
    "ExportedEnv": lambda source, state: source.render(state),
    "Overcooked": _draw_overcooked,
    "EnemySMAX": _draw_smax,
    "SimpleMPE": _draw_mpe,
}
"""Drawing functions by the name of JaxMARL's class or of one of its base classes."""
