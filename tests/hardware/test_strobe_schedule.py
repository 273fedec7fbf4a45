"""Strobe schedules, and the simulated device that follows them."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from pydantic import TypeAdapter, ValidationError

from compute.errors import InvalidParameter
from hardware.simulated.driver import SimulatedDriver
from hardware.simulated.scenes import StillPoints
from hardware.simulated.settings import SimulationSettings
from hardware.strobe_schedule import StrobeSchedule


def test_no_marker_is_needed_where_all_are_lit() -> None:
    assert StrobeSchedule((None,)).markers == 0
    assert StrobeSchedule((None, 3)).markers == 4


@pytest.mark.parametrize("slots", [(), (0,) * 255, (-1,), (254,)])
def test_impossible_schedules_are_refused(slots: tuple[int, ...]) -> None:
    with pytest.raises(InvalidParameter, match=r"slots|marker"):
        StrobeSchedule(slots)
    with pytest.raises((ValidationError, InvalidParameter)):
        TypeAdapter(StrobeSchedule).validate_python({"slots": slots})


def frames(settings: SimulationSettings) -> list[Any]:
    driver = SimulatedDriver("sim", settings)
    driver.open()
    return list(driver.frames())


def test_the_simulated_device_lights_what_the_schedule_says() -> None:
    near, far = (-300.0, 0.0, 1500.0), (300.0, 0.0, 1500.0)
    settings = SimulationSettings(
        scene=StillPoints((near, far)), frame_rate_hz=100.0, duration_s=0.2, realtime=False
    )
    scheduled = frames(replace(settings, strobe=StrobeSchedule((1, 1, 0))))
    assert [frame.marker for frame in scheduled] == ([1, 1, 0] * 7)[:20]
    peaks = {frame.marker: frame.lines.argmax(axis=1) for frame in frames(settings)}
    for frame in scheduled:
        assert np.abs(frame.lines.argmax(axis=1) - peaks[frame.marker]).max() <= 3
    assert np.abs(peaks[0] - peaks[1]).max() > 100


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"illumination": "simultaneous", "strobe": StrobeSchedule((0,))}, "leave one"),
        ({"strobe": StrobeSchedule((0, 2))}, "0 to 1"),
        ({"strobe": StrobeSchedule((0, None))}, "must light one"),
    ],
)
def test_the_simulated_device_refuses_what_it_cannot_do(
    changes: dict[str, Any], words: str
) -> None:
    with pytest.raises(InvalidParameter, match=words):
        SimulationSettings(**changes)
