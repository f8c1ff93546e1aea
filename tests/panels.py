"""What the tests of pictures share: all views of a recording in one picture, and which of them shows nothing."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from viz_estim.recording.viewer import Viewer

Cell = tuple[str, str, slice, slice]  # a view's name and class, and the rows and columns of its pixels
COLOURFUL = 12  # pixels that a line or a few points have at least; an empty view has axes and texts, all grey
HEAD, FOOT, TITLE = 37, 28, 28  # what the viewer takes of a window above and below the views, and of each view


def emptiness(view_class: str, pixels: np.ndarray) -> str:
    """What a view lacks to be called drawn, or nothing."""
    if view_class == "TextDocument":
        return "" if (pixels.max(-1) > 120).mean() > 0.005 else "no text"
    pale = 25 if view_class == "StateTimeline" else 50  # lanes are in quiet colours
    colourful = int((pixels.max(-1) - pixels.min(-1) > pale).sum())
    return "" if colourful >= COLOURFUL else f"{colourful} pixels of any colour"


def assert_all_drawn(viewer: Viewer, size: tuple[int, int], timeline: str, value: float, png: Path) -> None:
    """At a moment, all views of all tabs draw without a complaint, and show something; size: the window's."""
    cells = side_by_side(viewer, size)
    viewer.seek(timeline, value)
    viewer.snapshot(png, settle=0)
    if empty(cells, png):  # only then is it worth a second picture whether the first was taken too early
        assert viewer.snapshot(png)
    assert empty(cells, png) == {}
    assert viewer.problems() == []
    assert len(viewer.views()) == len(cells)
    assert all(view.visible for view in viewer._client.get_state().views)


def empty(cells: Sequence[Cell], png: Path) -> dict[str, str]:
    """By name, what the views lack that show nothing."""
    pixels = np.asarray(Image.open(png).convert("RGB")).astype(int)
    lacks = {name: emptiness(kind, pixels[rows, columns]) for name, kind, rows, columns in cells}
    return {name: lack for name, lack in lacks.items() if lack}


def side_by_side(viewer: Viewer, size: tuple[int, int]) -> list[Cell]:
    """Puts all views of all tabs into one grid; each one's name and class, and the pixels that it has for itself."""
    blueprint: dict[str, Any] = viewer._client.get_blueprint().blueprint
    views = [path.lstrip("/") for path, fields in blueprint.items() if "ViewBlueprint" in fields]
    across = int(np.ceil(np.sqrt(len(views))))
    down = -(-len(views) // across)
    root = blueprint["/viewport"]["ViewportBlueprint"]["root_container"]
    kept = {path: fields for path, fields in blueprint.items() if not path.startswith("/container/")}
    grid = {"container_kind": "Grid", "contents": views, "grid_columns": across}
    viewer._client.set_blueprint(kept | {f"/container/{root}": {"ContainerBlueprint": grid}}, of="recording")
    width, height = size[0] / across, (size[1] - HEAD - FOOT) / down
    cells = []
    for i, path in enumerate(views):
        view = blueprint[f"/{path}"]["ViewBlueprint"]
        x, y = i % across * width, HEAD + i // across * height
        rows, columns = slice(int(y) + TITLE, int(y + height) - 2), slice(int(x) + 2, int(x + width) - 2)
        cells.append((view["display_name"], view["class_identifier"], rows, columns))
    return cells
