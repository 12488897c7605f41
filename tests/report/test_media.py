"""Films and maps as data URIs."""

import base64
import io

import imageio.v3 as iio
import imageio_ffmpeg
import numpy as np
import pytest

from hmasd_jax.report import media


def decode(uri, kind):
    assert uri.startswith(f"data:{kind};base64,")
    return base64.b64decode(uri.partition(",")[2])


def noise(count):
    return list(np.random.default_rng(0).integers(0, 255, (count, 64, 96, 3), np.uint8))


def test_a_film_keeps_all_frames_that_fit(tmp_path):
    film = media.make_film(noise(6), limit=10**7)
    assert (film.shown, film.total) == (6, 6)
    path = tmp_path / "film.mp4"
    path.write_bytes(decode(film.uri, "video/mp4"))
    assert imageio_ffmpeg.count_frames_and_secs(str(path)) == (6, pytest.approx(6 / 5, abs=0.05))
    poster = iio.imread(io.BytesIO(decode(film.poster, "image/webp")))
    assert poster.shape == (64, 96, 3)


def test_a_film_that_is_too_large_loses_its_end():
    whole = len(decode(media.make_film(noise(40), limit=10**7).uri, "video/mp4"))
    film = media.make_film(noise(40), limit=whole // 2)
    assert 5 < film.shown < 25
    assert film.total == 40
    assert len(decode(film.uri, "video/mp4")) <= whole // 2


def test_a_map_is_darkest_where_agents_stay():
    picture = np.full((40, 60, 3), 200, np.uint8)
    shares = np.zeros((4, 6))
    shares[1, 2], shares[3, 5] = 0.8, 0.2
    drawn = media.draw_map(picture, shares, 10, "#0000ff", (slice(None), slice(10, None)))
    assert drawn.shape == (40, 50, 3)
    most, some, none = drawn[15, 15], drawn[35, 45], drawn[0, 0]
    assert most[0] < some[0] < none[0]
    assert most[2] > 240


def test_a_large_map_is_cropped_around_what_is_visited():
    shares = np.zeros((20, 30))
    shares[8:10, 15] = 0.5
    rows, columns = media.crop_box([shares], 10, (200, 300))
    assert (rows.start, rows.stop, columns.start, columns.stop) == (60, 120, 130, 180)
    assert media.crop_box([0 * shares], 10, (200, 300)) == (slice(None), slice(None))
