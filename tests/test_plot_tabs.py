"""The tabs of plots: none crowded, each told what its colours are, numbers named in words."""

from types import SimpleNamespace
from typing import Any

import pytest
import rerun.blueprint as rrb

from viz_estim.core.spaces import SE2, SO2, SO3, Euclidean, Product
from viz_estim.recording import blueprints, plot_tabs
from viz_estim.recording.ranges import Ranges

XYZ = ("x", "y", "z")


def layout(space: Product, **known: Any) -> Any:
    """A layout of that state, with a truth and a gain, and nothing else unless it is said."""
    nothing = {
        "labels": (),
        "stages": {"update": {"gain": {"shape": [2, 1]}}},
        "sensors": {},
        "inputs": {},
        "matched": False,
    }
    place = list(known.get("sensors", {})).index
    given = {"particles": 0, "duration": 9.0, "true_parts": list(space.parts), "place": place, "space": space}
    return SimpleNamespace(**nothing | given | {"ranges": Ranges()} | known)


def names(tabs: list[Any]) -> list[str]:
    return [tab.name for tab in tabs]


def plots(tab: Any) -> list[rrb.TimeSeriesView]:
    return [view for row in tab.contents for view in row.contents]


def legends(tabs: list[Any]) -> list[str]:
    """The plots that have a legend."""
    shown = [view for tab in tabs for view in plots(tab)]
    return [v.name for v in shown if v.properties["PlotLegend"].visible.as_arrow_array()[0].as_py()]


def test_a_large_state_has_several_tabs_and_no_crowded_one() -> None:
    parts = {name: Euclidean(XYZ, unit) for name, unit in {"position": "m", "velocity": "m/s", "bias": "m/s²"}.items()}
    state = Product(**parts, attitude=SO3(), gyro_bias=Euclidean(XYZ, "rad/s"))
    tabs = plot_tabs.tabs(layout(state, sensors={"pose": Product(position=Euclidean(XYZ, "m"), attitude=SO3())}))
    assert names(tabs) == [
        "Innovations, ±3σ grey", "Errors, ±3σ grey", "Errors 2", "State: estimate amber, truth white", "State 2", "σ",
        "What moved it, in σ before", "What moved it 2",
    ]  # fmt: skip
    assert max(len(tab.contents) for tab in tabs) <= 3
    assert sum(len(plots(tab)) for tab in tabs if tab.name.startswith("State")) == len(state.names)
    assert legends(tabs) == ["position σ [m]", "K·ν on position x [σ]"]  # the others' axes are the same


def test_errors_and_nis_come_first_and_innovations_stand_beside_them_where_there_is_room() -> None:
    sensors = {"accel": Euclidean(XYZ, "m/s²"), "gyro": Euclidean(XYZ, "rad/s")}
    first, second, *_ = plot_tabs.tabs(layout(Product(attitude=SO3()), sensors=sensors))
    assert [[view.name for view in row.contents] for row in first.contents] == [
        [f"attitude {axis} error [deg]" for axis in XYZ],
        ["NIS accel: 3 expected, 95 % between the lines", "NIS gyro: 3 expected, 95 % between the lines"],
    ]
    assert second.name.startswith("Innovations")
    only = plot_tabs.tabs(layout(Product(attitude=SO3()), sensors={"accel": sensors["accel"]}))[0]
    assert [len(row.contents) for row in only.contents] == [3, 3, 1]
    pose = Product(position=Euclidean(("x", "y"), "m"), heading=SO2())
    assert [len(row.contents) for row in plot_tabs.tabs(layout(pose))[0].contents] == [3]


def test_a_small_state_has_its_sigma_beneath_it_and_names_who_reads_it() -> None:
    place = Euclidean(("x", "y"), "m")
    state = Product(position=place, heading=SO2())
    (_, tab, _) = plot_tabs.tabs(layout(state, sensors={"gps": place}, true_parts=["heading"]))
    assert tab.name == "State: estimate amber, truth white, gps cyan"
    assert [view.name for view in plots(tab)] == [
        "position x [m]", "position y [m]", "heading [deg]", "position σ [m]", "heading σ [deg]"
    ]  # fmt: skip
    assert legends([tab]) == ["position σ [m]"]


def test_a_pose_has_its_sigma_in_two_plots_of_a_unit_each() -> None:
    (tab,) = plot_tabs.tabs(layout(Product(pose=SE2()), true_parts=[], stages={}))
    assert tab.name == "State: estimate amber"
    assert [view.name for view in plots(tab)[-2:]] == ["pose σ [m]", "pose σ [deg]"]


@pytest.mark.parametrize(
    ("name", "axis", "title"),
    [("accel", "x", "accel x"), ("heading", "angle", "heading"), ("range/1", "range", "range/1"), ("y", "y", "y"),
     ("state", "vx", "vx"), ("range", "range0", "range0"), ("range", "rangefinder", "range rangefinder"),
     ("pose", "attitude.roll.angle", "pose attitude.roll")],
)  # fmt: skip
def test_a_title_says_nothing_twice(name: str, axis: str, title: str) -> None:
    assert plot_tabs.titled(name, axis) == title


@pytest.mark.parametrize(("duration", "link"), [(59.0, 2), (61.0, 1)])
def test_plots_zoom_together_but_of_a_long_run_they_show_all(duration: float, link: int) -> None:
    (tab,) = plot_tabs.tabs(layout(Product(x=Euclidean(["x"])), stages={}, true_parts=[], duration=duration))
    axes = [view.properties["TimeAxis"] for view in plots(tab)]
    assert {axis.link.as_arrow_array()[0].as_py() for axis in axes} == {link}
    assert {axis.view_range is None for axis in axes} == {link == 2}


def test_single_numbers_stand_one_below_the_other_and_are_named_in_words() -> None:
    one = {"shape": []}
    stages = {"weigh": {"evidence": one, "ess": one}, "resample": {"distinct": one, "ess": one, "own": one}}
    known = layout(Product(pose=SE2()), true_parts=[], stages=stages, particles=1200)
    figures = plot_tabs.tabs(known)[0]
    assert figures.name == "Figures"
    assert [len(row.contents) for row in figures.contents] == [2, 2]
    assert [view.name for view in plots(figures)] == [
        "weigh: log-evidence of the reading", "weigh: effective sample size before resampling, of 1200",
        "resample: distinct ancestors, of 1200", "resample: own",
    ]  # fmt: skip
    alone = layout(Product(pose=SE2()), true_parts=[], stages={"resample": stages["resample"]}, particles=9)
    assert len(plots(plot_tabs.tabs(alone)[0])) == 3  # nothing else tells its effective sample size
    plain = layout(Product(x=Euclidean(["x"])), stages={"update": {"ess": one, "rmse": one}}, true_parts=[])
    assert [view.name for view in plots(plot_tabs.tabs(plain)[0])] == ["update: ess", "update: rmse"]


@pytest.mark.parametrize("count", range(1, 7))
def test_lanes_are_whole_in_a_small_window_and_leave_the_plots_half_of_it(count: int) -> None:
    share = plot_tabs.lanes_share(count)
    head, foot, title, ruler, lane = 37, 31, 27, 20, 40  # pixels, measured in a picture of 1280 x 720
    assert share == 0.5 or share * (720 - head - foot) >= title + ruler + count * lane
    assert share <= 0.5


def test_a_run_that_says_not_what_to_look_at_is_explained_in_a_few_lines() -> None:
    pose = layout(Product(pose=SE2()), explained=False, attitude=None)
    text = blueprints.legend(pose)
    assert "NIS" in text
    assert len(text) < 600
    assert "NIS" not in blueprints.legend(layout(Product(pose=SE2()), explained=True, attitude=None))
    assert "NIS" not in blueprints.legend(layout(Product(pose=SE2()), explained=False, attitude=None, particles=9))
