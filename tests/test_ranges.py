"""Axes: most of the values are in sight, wherever a few are; and at least two numbers stand beside a low plot."""

import numpy as np
import pytest

from viz_estim.recording.ranges import Ranges, readable


def shown(*lines: np.ndarray) -> tuple[float, float]:
    ranges = Ranges()
    for line in lines:
        ranges.learn("plot", line.reshape(len(line), -1))
    axis = ranges.axis("plot")
    assert axis is not None
    low, high = axis.range.as_arrow_array().to_pylist()[0]
    return low, high


def test_a_wide_first_band_does_not_flatten_the_rest() -> None:
    bound = 0.4 + 15 * np.exp(-np.arange(2500) / 10)
    low, high = shown(np.stack([-bound, bound], axis=1), 0.1 * np.sin(np.arange(2500)))
    assert low < -0.4
    assert 0.4 < high < low + 3


def test_two_outliers_leave_the_frame_and_a_lasting_error_does_not() -> None:
    values = np.sin(0.1 * np.arange(3000))
    values[[700, 900]] = 50, -70
    assert shown(values)[1] - shown(values)[0] < 5
    values[2000:2200] = 30
    assert shown(values)[1] >= 30


@pytest.mark.parametrize("length", [1, 3, 40])
def test_all_of_a_calm_plot_is_in_sight(length: int) -> None:
    values = np.arange(length + 1.0)
    low, high = shown(values)
    assert low <= 0 < length <= high


@pytest.mark.parametrize("seed", range(20))
def test_at_least_two_powers_of_ten_are_named_and_at_most_half_the_plot_is_empty(seed: int) -> None:
    rng = np.random.default_rng(seed)
    low, high = np.sort(10 ** rng.uniform(-4, 4) * (rng.standard_normal(2)))
    a, b = readable(low, high)
    assert a <= low < high <= b
    assert b - a < 2.8 * (high - low)
    top = b - 0.08 * (b - a)  # a number nearer to the upper end is cut off
    steps = 10.0 ** np.arange(-9, 9)
    named = [step for step in steps if np.floor(top / step) - np.ceil(a / step) >= 1 and (b - a) / step < 8]
    assert named


@pytest.mark.parametrize("bound", [2.2, 2.3, 2.4])
def test_of_the_room_about_most_values_a_little_less_is_shown_where_a_small_window_then_names_numbers(
    bound: float,
) -> None:
    values = np.full((3000, 2), [-1.7, 1.7])
    values[:50] = -bound, bound
    low, high = shown(values)
    assert -bound <= low < -1.7
    assert high > 2.3  # or the number 2 would be cut off
    assert high - low < 4.6


def test_nothing_and_a_constant_have_no_axis_of_their_own() -> None:
    ranges = Ranges()
    ranges.learn("constant", np.ones((9, 1)))
    ranges.learn("unknown", np.full((9, 1), np.nan))
    assert ranges.axis("constant") is ranges.axis("unknown") is ranges.axis("never") is None


def test_memory_is_bounded_and_all_of_a_run_counts() -> None:
    ranges = Ranges()
    for k in range(20):
        ranges.learn("plot", np.full((700, 1), float(k)))
        assert sum(len(values) for values in ranges._seen["plot"]._waiting) <= 4096
    axis = ranges.axis("plot")
    assert len(ranges._seen["plot"]._low) <= 4096
    assert axis is not None
    ((low, high),) = axis.range.as_arrow_array().to_pylist()
    assert low <= 0 < 19 <= high


@pytest.mark.parametrize(("scale", "above"), [(1.0, False), (500.0, True)])
def test_values_that_are_all_above_the_level_lines_are_in_sight(scale: float, above: bool) -> None:
    ranges, values = Ranges(), scale * np.random.default_rng(0).chisquare(3, 900)
    ranges.learn("plot", np.full((900, 2), [0.2, 9.3]))
    ranges.learn("plot", values[:, None])
    ((low, high),) = ranges.upward("plot", 28.0).range.as_arrow_array().to_pylist()
    assert low == 0
    assert (high > 28.0) == above
    assert np.mean(values <= high) > 0.9
    assert ranges.upward("never", 28.0).range.as_arrow_array().to_pylist() == [[0, 28.0]]


def test_a_high_plot_needs_no_number_that_is_far_away() -> None:
    ranges = Ranges()
    ranges.learn("/p", np.linspace(-360.0, 360.0, 100)[:, None])
    asked = [ranges.axis("/p"), ranges.asked("/p", 3), ranges.asked("/p", 1)]
    low, same, high = (axis.range.as_arrow_array().to_pylist()[0] for axis in asked if axis)
    assert low == same
    assert low[1] > 1000
    assert 360 < high[1] < 400
    assert ranges.asked("/unknown", 1) is None


def test_as_long_as_more_is_to_come_each_plot_shows_all() -> None:
    ranges = Ranges(fixed=False)
    ranges.learn("/p", np.arange(10.0)[:, None])
    assert ranges.axis("/p") is None
    ranges.fixed = True
    assert ranges.axis("/p") is not None
