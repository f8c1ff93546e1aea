"""Eyes: a scene is in sight whole, and not lost in its panel."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from viz_estim.core.quaternions import Array
from viz_estim.core.spaces import Euclidean, Product
from viz_estim.recording import eyes
from viz_estim.recording.scene_views import Scenes, view

HALF_VIEW = np.tan(np.radians(27.5))  # of the viewer's field of view upwards


def seen(eye: object, points: Array) -> Array:
    """Where points (N, 3) are in the picture: across and up (N, 2), 1 being half the picture's height."""
    fields = [getattr(eye, name).as_arrow_array().to_pylist()[0] for name in ("position", "look_target", "eye_up")]
    position, target, up = map(np.array, fields)
    ahead = (target - position) / np.linalg.norm(target - position)
    right = np.cross(ahead, up) / np.linalg.norm(np.cross(ahead, up))
    away = points - position
    return np.stack([away @ right, away @ np.cross(right, ahead)], axis=-1) / (away @ ahead)[:, None] / HALF_VIEW


@pytest.mark.parametrize("halves", [(1, 1, 1), (5, 3, 0.5), (0.5, 9, 0.1), (40, 30, 2)])
@pytest.mark.parametrize("centre", [(0, 0, 0), (100, -20, 3)])
def test_a_box_in_space_fills_the_picture_and_is_whole_but_for_its_corners(
    halves: tuple[float, ...], centre: tuple[float, ...]
) -> None:
    half, middle = np.array(halves, float), np.array(centre, float)
    eye = eyes.aside(middle, half)
    faces = middle + half * np.concatenate([np.eye(3), -np.eye(3)])
    places = seen(eye, faces)
    assert np.abs(places[:, 1]).max() < 1
    assert np.abs(places).max() > 0.5


@pytest.mark.parametrize("count", [2, 3, 10])
def test_bars_are_in_sight_and_half_as_high_as_the_picture_where_they_are_few(count: int) -> None:
    ends = np.array([[0.0, 0, 0], [0.5 * (count - 1), 1, 0]])
    places = seen(eyes.bars(count), ends)
    assert np.abs(places).max() < 1
    assert np.ptp(places[:, 1]) > (0.9 if count < 4 else 0.3)


def run(place: int, metres: float, of_first: bool) -> Any:
    """A run whose body drove so many metres along x and y, with what a view asks of it."""
    way = np.linspace([0.0, 0.0], [metres, metres], 20)
    space = Product(position=Euclidean(("x", "y"), "m"))
    record = SimpleNamespace(truth=way, mean=way, labels=())
    return SimpleNamespace(
        run=record, place=place, space=space, of_first=of_first, name=str(place), path=f"/runs/{place}"
    )


def test_runs_on_one_set_of_data_share_an_eye_and_one_in_another_world_has_its_own() -> None:
    runs = [run(0, 10, True), run(1, 300, True), run(2, 1000, False)]
    scenes = Scenes()
    scenes.standing = {1: [np.array([[2.0, 3.0, 0.0]])], 2: [np.array([[900.0, 0.0, 0.0]])]}
    views = [view("/world", [one], runs[0], scenes, one.name, 2.0) for one in runs]
    heights = [v.properties["EyeControls3D"].position.as_arrow_array().to_pylist()[0][2] for v in views]
    assert heights[0] == heights[1] < 20
    assert heights[2] > 1000


@pytest.mark.parametrize("reach", [0.01, 0.5, 3, 20, 47, 1234])
def test_a_grid_has_round_lines_and_neither_few_nor_many(reach: float) -> None:
    spacing = eyes.spacing(reach)
    assert f"{spacing:e}"[0] in "125"
    assert 4 <= 2 * max(reach, 0.5) / spacing <= 14
