"""Settings: bounds in Python and JSON; the scene is chosen by ``kind``."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from pydantic import TypeAdapter, ValidationError

from compute.errors import InvalidParameter
from hardware.simulated.scenes import CalibrationTarget, RotatingBar, StillPoints
from hardware.simulated.settings import SimulationSettings

BODY = TypeAdapter(SimulationSettings)

OUT_OF_BOUNDS = [
    ("frame_rate_hz", 0.0),
    ("frame_rate_hz", 20_000.0),
    ("spot_sigma_px", 0.0),
    ("signal_electrons", -1.0),
    ("ambient_electrons", -1.0),
    ("read_noise_electrons", -1.0),
    ("full_well_electrons", 0.0),
    ("electrons_per_count", 0.0),
    ("offset_counts", -1.0),
    ("bits", 7),
    ("bits", 17),
    ("bits", 11.5),
    ("seed", -1),
    ("duration_s", 0.0),
    ("illumination", "alternating"),
    ("peaks", "median"),
]


@pytest.mark.parametrize(("field", "value"), [*OUT_OF_BOUNDS, ("duration_s", np.nan)])
def test_python_refuses_values_out_of_bounds(field: str, value: Any) -> None:
    with pytest.raises(InvalidParameter, match=f"{field} is .*; it must be") as refused:
        replace(SimulationSettings(), **{field: value})
    assert str(value) in refused.value.detail


@pytest.mark.parametrize(("field", "value"), OUT_OF_BOUNDS)
def test_a_request_body_is_refused_by_the_same_bounds(field: str, value: Any) -> None:
    with pytest.raises(ValidationError) as refused:
        BODY.validate_python({field: value})
    assert refused.value.errors()[0]["loc"][0] == field


@pytest.mark.parametrize(
    "scene",
    [
        CalibrationTarget(scale=0.8),
        StillPoints(((0.0, 1.0, 1500.0), (2.0, 3.0, 1400.0))),
        RotatingBar(plane_normal=(0.0, 0.0, 1.0)),
    ],
)
def test_settings_go_through_json_and_back(
    scene: CalibrationTarget | StillPoints | RotatingBar,
) -> None:
    settings = SimulationSettings(scene=scene, duration_s=2.5, illumination="simultaneous")
    assert BODY.validate_json(BODY.dump_json(settings)) == settings


def test_an_empty_body_is_the_default() -> None:
    assert BODY.validate_json("{}") == SimulationSettings()


@pytest.mark.parametrize(
    "body",
    [
        '{"colour": 1}',
        '{"scene": {"kind": "rotating-bar", "colour": 1}}',
        '{"scene": {"kind": "circus"}}',
        '{"scene": {"length_mm": 292}}',
    ],
)
def test_unknown_fields_and_scenes_are_refused(body: str) -> None:
    with pytest.raises(ValidationError):
        BODY.validate_json(body)


@pytest.mark.parametrize(
    ("duration_s", "rate_hz", "frames"),
    [
        (None, 1000.0, None),
        (60.0, 1000.0, 60_000),
        (0.3, 10.0, 3),
        (0.29, 100.0, 29),
        (1e-6, 1.0, 1),
    ],
)
def test_frames_in_a_duration(duration_s: float | None, rate_hz: float, frames: int | None) -> None:
    settings = SimulationSettings(duration_s=duration_s, frame_rate_hz=rate_hz)
    assert settings.timing.frames == frames
