"""Pictures and films as data URIs, small enough for a page that carries all of them."""

import base64
import io
import tempfile
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hmasd_jax.analysis.render import write

SECONDS = 15.0
"""Longest film at the slowest speed; longer episodes play faster."""
SLOWEST, FASTEST = 5.0, 20.0
"""Frames per second."""


class Film(NamedTuple):
    """An animation as a data URI."""

    uri: str
    shown: int
    """Number of frames in it."""
    total: int
    """Number of frames of the episode."""
    poster: str
    """First frame, shown before the film plays."""


def picture_uri(picture: NDArray[np.uint8], quality: int = 80) -> str:
    """Encode an image (height, width, 3 or 4) as WebP."""
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(picture).save(buffer, "webp", quality=quality)
    return _uri("image/webp", buffer.getvalue())


def make_film(frames: list[NDArray[np.uint8]], limit: int) -> Film:
    """Encode frames as MP4 of at most `limit` bytes, by leaving out the end of longer ones.

    The limit is not kept by films of two frames.
    """
    fps = float(np.clip(len(frames) / SECONDS, SLOWEST, FASTEST))
    shown = len(frames)
    with tempfile.TemporaryDirectory() as folder:
        while True:
            path = write(Path(folder) / "film.mp4", frames[:shown], fps)
            data = path.read_bytes()
            if len(data) <= limit or shown <= 2:
                break
            shown = max(2, min(shown - 1, int(0.9 * shown * limit / len(data))))
    return Film(
        uri=_uri("video/mp4", data),
        shown=shown,
        total=len(frames),
        poster=picture_uri(frames[0]),
    )


def _uri(kind: str, data: bytes) -> str:
    return f"data:{kind};base64,{base64.b64encode(data).decode()}"


def draw_map(
    picture: NDArray[np.uint8],
    shares: NDArray[np.floating],
    cell: int,
    color: str,
    box: tuple[slice, slice],
) -> NDArray[np.uint8]:
    """Paint where agents were over a faded picture.

    Args:
        picture: Picture of the environment, (height, width, 3).
        shares: Share of time per cell, (rows, columns).
        cell: Side of a cell, in pixels.
        color: Color of the skill, `#RRGGBB`.
        box: Rows and columns of the picture to show.
    """
    height, width = picture.shape[:2]
    faded = 255 - 0.35 * (255.0 - picture)
    # The root shows places that are visited seldom, too.
    depth = np.sqrt(shares / max(shares.max(), 1e-9)) * 0.9
    depth = depth.repeat(cell, 0).repeat(cell, 1)[:height, :width, None]
    ink = np.array(list(bytes.fromhex(color[1:])))
    painted = (1 - depth) * faded + depth * ink
    return painted.round().astype(np.uint8)[box]


def crop_box(
    shares: list[NDArray[np.floating]], cell: int, size: tuple[int, int]
) -> tuple[slice, slice]:
    """Return the rows and columns of a picture within 2 cells of any visited cell."""
    rows, columns = np.nonzero(np.sum(shares, axis=0))
    if not len(rows):
        return slice(None), slice(None)
    sides = []
    for index, length in zip((rows, columns), size):
        low, high = (index.min() - 2) * cell, (index.max() + 3) * cell
        sides.append(slice(max(low, 0), min(high, length)))
    return sides[0], sides[1]
