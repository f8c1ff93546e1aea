"""A world to look at, drawn here, and the pictures that a camera takes of it along a known attitude."""

from __future__ import annotations

import numpy as np

from viz_estim.core import quaternions
from viz_estim.core.panoramas import Picture, seen_from
from viz_estim.core.quaternions import Array

FIELD_OF_VIEW_DEG = (60.0, 45.0)  # the course's camera: across, up and down

_HEIGHT = 360  # rows of the panorama: half a degree each
# Letters of 5 × 7 dots, a row of five bits each.
_DOTS = {
    "N": (17, 25, 25, 21, 19, 19, 17),
    "E": (31, 16, 16, 30, 16, 16, 31),
    "S": (15, 16, 16, 14, 1, 1, 30),
    "W": (17, 17, 17, 21, 21, 27, 17),
    "0": (14, 17, 19, 21, 25, 17, 14),
    "3": (30, 1, 1, 14, 1, 1, 30),
    "6": (14, 16, 16, 30, 17, 17, 14),
}


def draw_panorama(rng: np.random.Generator) -> Picture:
    """A panorama (360, 720, 3): a town under a banded sky with sun and clouds, tiled ground, and what marks directions:
    N, W, S, E at azimuth 0, π/2, π, −π/2, and rows of numbers that say how high above the horizon they stand."""
    picture = np.zeros((_HEIGHT, 2 * _HEIGHT, 3), np.uint8)
    row, column = np.mgrid[:_HEIGHT, : 2 * _HEIGHT]
    elevation, azimuth = 90 - (row + 0.5) / 2, 180 - (column + 0.5) / 2
    band = np.floor(np.clip(elevation, 0, None) / 7.5)[..., None]
    picture[:] = np.array([205, 225, 240]) - band * np.array([13, 10, 5])
    _blobs(picture, rng, azimuth, elevation)
    _ground(picture, azimuth, elevation)
    _houses(picture, rng)
    for centre, letter in ((0, "N"), (90, "W"), (-90, "E"), (179, "S")):
        _write(picture, letter, centre, 16, 4, (200, 30, 30))
    for azimuth_deg in range(-165, 180, 30):
        for height, text in ((30, "30"), (60, "60"), (-30, "30"), (-60, "60")):
            _write(picture, text, azimuth_deg, height, 2, (250, 250, 210) if height < 0 else (40, 60, 120))
    return picture


def take_pictures(
    panorama: Picture, stamps: Array, attitude: Array, *, rate_hz: float, shape: tuple[int, int]
) -> tuple[Array, Picture]:
    """Stamps (K,) s and pictures (K, *shape, 3) along attitudes (T, 4) at `stamps` (T,), NaN where it is not known.

    Pictures come evenly, and between the stamps; none is taken beside an attitude that is not known.
    """
    times = np.arange(stamps[0] + 0.5 / rate_hz, stamps[-1], 1 / rate_hz)
    after = np.searchsorted(stamps, times)
    known = np.asarray(np.isfinite(attitude).all(1))
    times = times[known[after] & known[after - 1]]
    if not len(times):
        return times, np.empty((0, *shape, 3), np.uint8)
    at = quaternions.slerp(times, stamps[known], attitude[known])
    across, up = np.radians(FIELD_OF_VIEW_DEG)
    return times, np.stack([seen_from(panorama, q, shape, (across, up)) for q in at])


def _blobs(picture: Picture, rng: np.random.Generator, azimuth: Array, elevation: Array) -> None:
    """A sun and a few clouds."""
    for _ in range(14):
        centre, height, size = rng.uniform(-180, 180), rng.uniform(25, 80), rng.uniform(3, 7)
        away = (azimuth - centre + 180) % 360 - 180
        wide = 2.5 / np.cos(np.radians(height))
        picture[(away / wide) ** 2 + (elevation - height) ** 2 < size**2] = (245, 247, 250)
    picture[(azimuth - 40) ** 2 * 0.6 + (elevation - 40) ** 2 < 25] = (255, 215, 80)


def _ground(picture: Picture, azimuth: Array, elevation: Array) -> None:
    """Fields of a chessboard on the ground, smaller towards the horizon as on a plain."""
    below = elevation < 0
    away = 1 / np.tan(np.radians(np.clip(-elevation, 4, 90)))  # in heights of the camera
    ring, sector = np.floor(2 * np.log2(1 + away)), np.floor(azimuth / 15)
    odd = (ring + sector) % 2 > 0
    picture[below & odd], picture[below & ~odd] = (96, 130, 78), (128, 158, 96)
    picture[below & (np.abs(azimuth) < 9)] = (120, 112, 104)  # a road to the north
    picture[below & (np.abs(azimuth) < 1)] = (235, 235, 225)


def _houses(picture: Picture, rng: np.random.Generator) -> None:
    """A row of houses on the horizon, with windows."""
    horizon, left = _HEIGHT // 2, 0
    while left < 2 * _HEIGHT - 8:
        width = int(rng.integers(16, 48))
        top = horizon - int(rng.integers(8, 44))
        wall = rng.integers(60, 220, 3).astype(np.uint8)
        right = min(left + width, 2 * _HEIGHT)
        picture[top:horizon, left:right] = wall
        lit = np.array([250, 235, 160]) if rng.random() < 0.5 else np.array([40, 50, 70])
        for y in range(top + 3, horizon - 4, 9):
            for x in range(left + 3, right - 4, 8):
                picture[y : y + 5, x : x + 4] = lit
        left = right + int(rng.integers(0, 14))


def _write(
    picture: Picture, text: str, azimuth_deg: float, elevation_deg: float, size: int, colour: tuple[int, int, int]
) -> None:
    """A text whose dots are `size` pixels, about a direction."""
    dots = np.concatenate([[[row >> 4 - i & 1 for i in range(5)] + [0] for row in _DOTS[one]] for one in text], axis=1)
    mark = np.kron(dots, np.ones((size, size), int)) > 0
    rows, columns = np.nonzero(mark)
    top = round(2 * (90 - elevation_deg)) - mark.shape[0] // 2
    left = round(2 * (180 - azimuth_deg)) - mark.shape[1] // 2
    picture[top + rows, (left + columns) % (2 * _HEIGHT)] = colour
