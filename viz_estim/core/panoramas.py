"""Pictures and the sphere around them: a pinhole camera's rays, bilinear sampling, a canvas of tiles.

The camera looks along the body's x axis: y is to the picture's left, z up. A panorama or canvas unrolls the sphere:
column 0 begins at azimuth π (a turn to the left goes to the left), row 0 at elevation π/2; H rows, 2H columns.
Pixels stand for their centres. Colours are RGB, 0 to 255.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from viz_estim.core import quaternions
from viz_estim.core.quaternions import Array

Picture = NDArray[np.uint8]

HEIGHT = 360  # of the canvas: half a degree a pixel, about what the course's camera resolves
_TILE = 20  # pixels: ten degrees

Tiles = tuple[NDArray[np.float32], ...]  # each (_TILE, _TILE, 4): Σ weight·RGB and Σ weight of the pictures there


@dataclass(frozen=True)
class _Grid:
    """The canvas's tiles: directions (n, _TILE, _TILE, 3) of their pixels, centres (n, 3), and how far (rad) the
    farthest pixel is from its tile's centre."""

    directions: Array
    centres: Array
    radius: float


def directions(height: int) -> Array:
    """Unit vectors (height, 2·height, 3) in the world, of a canvas's pixels."""
    elevation = np.pi * (0.5 - (np.arange(height) + 0.5) / height)[:, None]
    azimuth = np.pi * (1 - (np.arange(2 * height) + 0.5) / height)
    flat = np.cos(elevation)
    return np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation) + 0 * azimuth], axis=-1)


def place_on(height: int, direction: Array) -> Array:
    """Row and column (*, 2) on a canvas of that height for directions (*, 3) of any length."""
    azimuth = np.arctan2(direction[..., 1], direction[..., 0])
    elevation = np.arctan2(direction[..., 2], np.hypot(direction[..., 0], direction[..., 1]))
    return np.stack([(0.5 - elevation / np.pi) * height - 0.5, (1 - azimuth / np.pi) * height - 0.5], axis=-1)


def rays(across: Array, down: Array, field_of_view: tuple[float, float]) -> Array:
    """Rays (*, 3) in the body, x = 1, through points of the picture: across and down run from −1 to 1."""
    slope_y, slope_z = np.tan(0.5 * np.array(field_of_view))
    return np.stack([np.ones_like(across), -slope_y * across, -slope_z * down], axis=-1)


def sample(picture: Picture, at: Array, *, around: bool = False) -> Array:
    """Colours (*, 3) at rows and columns (*, 2), bilinear; beyond the border its colour. around: the columns close."""
    rows, columns = picture.shape[:2]
    low = np.floor(at).astype(int)
    down, across = (at - low)[..., 0, None], (at - low)[..., 1, None]
    top, bottom = (np.clip(low[..., 0] + i, 0, rows - 1) for i in (0, 1))
    left, right = ((low[..., 1] + j) % columns if around else np.clip(low[..., 1] + j, 0, columns - 1) for j in (0, 1))
    upper = picture[top, left] * (1 - across) + picture[top, right] * across
    lower = picture[bottom, left] * (1 - across) + picture[bottom, right] * across
    return upper * (1 - down) + lower * down


def seen_from(panorama: Picture, q: Array, shape: tuple[int, int], field_of_view: tuple[float, float]) -> Picture:
    """The picture of `shape` (rows, columns) that a camera of attitude q (4,), body → world, takes of a panorama."""
    rows, columns = shape
    across, down = (2 * (np.arange(n) + 0.5) / n - 1 for n in (columns, rows))
    ray = rays(*np.meshgrid(across, down), field_of_view)
    at = place_on(panorama.shape[0], ray @ quaternions.to_matrix(q).T)
    return np.round(sample(panorama, at, around=True)).astype(np.uint8)


def blank() -> Tiles:
    """A canvas on which nothing was painted."""
    nothing = np.zeros((_TILE, _TILE, 4), np.float32)
    return (nothing,) * len(_grid().centres)


def paint(tiles: Tiles, picture: Picture, q: Array, field_of_view: tuple[float, float]) -> tuple[Tiles, float]:
    """The canvas with a picture (M, N, 3) added, taken at attitude q (4,), body → world; and how ill the picture fits:
    the root mean squared difference from what was there, weighted as it is painted, 0 where nothing was.

    Each pixel of the canvas looks into the picture, bilinear. Weights fall from 1 at the picture's middle to 0 at its
    border, so that no seam is seen (Szeliski 2006, section 6.2). Tiles that it does not reach are shared with the old.
    """
    grid, R = _grid(), quaternions.to_matrix(q)
    slopes = np.tan(0.5 * np.array(field_of_view))
    reach = np.arctan(np.hypot(*slopes)) + grid.radius
    near = np.flatnonzero(grid.centres @ R[:, 0] > np.cos(reach))
    body = grid.directions[near] @ R
    ahead = body[..., 0] > 1e-6
    across, down = (-body[..., i + 1] / np.where(ahead, body[..., 0], 1) / slopes[i] for i in (0, 1))
    inside = ahead & (np.abs(across) < 1) & (np.abs(down) < 1)
    across, down = across[inside], down[inside]
    rows, columns = picture.shape[:2]
    at = np.stack([0.5 * (down + 1) * rows - 0.5, 0.5 * (across + 1) * columns - 0.5], axis=-1)
    weight = ((1 - np.abs(across)) * (1 - np.abs(down)))[:, None]
    colours = sample(picture, at)
    there = np.stack([tiles[i] for i in near])[inside]
    common = weight * (there[:, 3:] > 0)
    squared = (colours - there[:, :3] / np.maximum(there[:, 3:], 1e-9)) ** 2
    mismatch = float(np.sqrt((common * squared).sum() / (3 * max(common.sum(), 1e-9))))
    added = np.zeros((*inside.shape, 4), np.float32)
    added[inside] = np.concatenate([weight * colours, weight], axis=1)
    painted = list(tiles)
    for i in np.flatnonzero(inside.any((1, 2))):
        painted[near[i]] = tiles[near[i]] + added[i]
    return tuple(painted), mismatch


def unrolled(tiles: Tiles) -> tuple[Picture, NDArray[np.bool_]]:
    """The canvas (H, 2H, 3), black where nothing was seen, and where something was (H, 2H)."""
    across = 2 * HEIGHT // _TILE
    sums = np.stack(tiles).reshape(-1, across, _TILE, _TILE, 4).swapaxes(1, 2).reshape(HEIGHT, 2 * HEIGHT, 4)
    weight = sums[..., 3:]
    colours = np.divide(sums[..., :3], weight, out=np.zeros_like(sums[..., :3]), where=weight > 0)
    return np.round(colours).astype(np.uint8), weight[..., 0] > 0


def similarity(tiles: Tiles, panorama: Picture) -> dict[str, float]:
    """How like the true panorama (H', 2H', 3) the canvas is where it was painted; nothing where it was not.

    psnr_db = 10·log₁₀(255² / mean squared error) over solid angle; seen_percent of the sphere was painted.
    """
    canvas, seen = unrolled(tiles)
    world = directions(HEIGHT)
    area = np.hypot(world[..., 0], world[..., 1])  # a row near the pole covers less of the sphere
    if not seen.any():
        return {}
    true = sample(panorama, place_on(panorama.shape[0], world), around=True)
    squared = ((canvas - true) ** 2).mean(-1)
    error = float(np.average(squared[seen], weights=area[seen]))
    share = 100 * float(area[seen].sum() / area.sum())
    return {"psnr_db": float(10 * np.log10(255**2 / max(error, 1e-12))), "seen_percent": share}


@cache
def _grid() -> _Grid:
    down, across = HEIGHT // _TILE, 2 * HEIGHT // _TILE
    tiles = directions(HEIGHT).reshape(down, _TILE, across, _TILE, 3).swapaxes(1, 2).reshape(-1, _TILE, _TILE, 3)
    centres = quaternions.normalise(tiles.mean((1, 2)))
    nearest = np.einsum("nijk,nk->nij", tiles, centres).min()
    return _Grid(tiles, centres, float(np.arccos(nearest)))
