"""A viewer that is slow, as on a machine without a graphics card that has other things to do: it is waited for."""

import time
from types import SimpleNamespace
from typing import Any

import pytest

from viz_estim.recording.viewer import Viewer, ViewerError


class Busy:
    """A viewer that needs so many looks until its cursor stands where it was put, and misses its first deadlines."""

    def __init__(self, looks: int = 0, missed: int = 0) -> None:
        self.looks, self.missed, self.at = looks, missed, 0
        self.line = SimpleNamespace(name="step", time_type="sequence", start=0, end=9)

    def get_state(self) -> Any:
        self.missed -= 1
        if self.missed >= 0:
            raise TimeoutError("Deadline expired before operation could complete")
        self.looks -= 1
        front = SimpleNamespace(
            store_id="a", timelines=[self.line], current_timeline="step", current_time=self.at * (self.looks < 0)
        )
        return SimpleNamespace(recordings=[front], active_recording="a")

    def set_time(self, timeline: str, *, sequence: int, play_state: str) -> None:
        self.at = sequence


def viewer_of(client: Busy) -> Viewer:
    viewer = Viewer.__new__(Viewer)
    viewer._client, viewer._closed = client, False  # type: ignore[assignment]
    viewer._process = SimpleNamespace(poll=lambda: None)  # type: ignore[assignment]
    return viewer


@pytest.mark.parametrize("client", [Busy(looks=8), Busy(missed=3)])
def test_a_moment_that_is_there_is_gone_to_however_slow_the_viewer(client: Busy) -> None:
    viewer_of(client).seek("step", 5, seconds=0.0)
    assert client.at == 5


def test_a_moment_that_is_not_there_is_waited_for_as_long_as_was_said() -> None:
    began = time.monotonic()
    with pytest.raises(ViewerError, match="step 12 is not recorded; choose from 0 to 9"):
        viewer_of(Busy()).seek("step", 12, seconds=0.1)
    assert 0.1 < time.monotonic() - began < 5
