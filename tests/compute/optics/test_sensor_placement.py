"""Placed sensors and ideal optics, checked by plain geometry."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from compute.errors import InvalidParameter
from compute.optics.ideal_optics import IdealOptics
from compute.optics.sensor_placement import PlacedSensor, Vector3, place_sensor

LENS = (120.0, -40.0, 15.0)
AIM = (0.0, 10.0, 1500.0)


def sensor(
    lens: Vector3 = LENS, aim: Vector3 = AIM, along: Vector3 = (1.0, 2.0, 0.0)
) -> PlacedSensor:
    return place_sensor(
        "one",
        lens_position_mm=lens,
        aim_mm=aim,
        measured_direction=along,
        principal_distance_mm=37.0,
        pixels=2048,
        pitch_um=12.0,
    )


def optics(falloff_mm: float | None = None) -> IdealOptics:
    return IdealOptics(
        [sensor()], spot_sigma_px=2.0, signal_electrons=1000.0, reference_distance_mm=falloff_mm
    )


def test_the_aim_is_read_in_the_middle_of_the_pixels() -> None:
    spots = optics().stripes(np.array([AIM]))
    assert spots.position_px[0, 0] == pytest.approx(1023.5, abs=1e-9)
    assert spots.sigma_px.tolist() == [[2.0]]
    assert spots.electrons.tolist() == [[1000.0]]


@given(
    along=st.floats(-300.0, 300.0),
    slit=st.floats(-300.0, 300.0),
    depth=st.floats(500.0, 3000.0),
)
def test_the_reading_is_the_tangent_of_the_angle_along_the_sensor(
    along: float, slit: float, depth: float
) -> None:
    axis = np.subtract(AIM, LENS) / np.linalg.norm(np.subtract(AIM, LENS))
    x = np.array([1.0, 2.0, 0.0]) - (axis @ [1.0, 2.0, 0.0]) * axis
    x /= np.linalg.norm(x)
    point = LENS + along * x + slit * np.cross(axis, x) + depth * axis
    reading = optics().stripes(point[None]).position_px[0, 0]
    assert reading == pytest.approx(1023.5 + 37.0 / 0.012 * along / depth, abs=1e-8)


def test_the_sensor_frame_is_right_handed() -> None:
    rotation = sensor().model.rotation
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1.0)


def test_a_point_behind_the_lens_gives_no_light() -> None:
    axis = np.subtract(AIM, LENS)
    spots = optics(1500.0).stripes(np.array([LENS - 0.1 * axis, LENS + 0.1 * axis]))
    assert np.isnan(spots.position_px[0, 0])
    assert spots.electrons[0, 0] == 0.0
    assert spots.electrons[1, 0] > 0.0


def test_light_falls_with_the_square_of_the_distance_to_the_lens() -> None:
    axis = np.subtract(AIM, LENS) / np.linalg.norm(np.subtract(AIM, LENS))
    points = np.array([LENS + 750.0 * axis, LENS + 1500.0 * axis, LENS + 3000.0 * axis])
    np.testing.assert_allclose(optics(1500.0).stripes(points).electrons[:, 0], [4000, 1000, 250])
    np.testing.assert_allclose(optics(None).stripes(points).electrons[:, 0], [1000, 1000, 1000])


def test_an_aim_on_the_lens_is_refused() -> None:
    with pytest.raises(InvalidParameter, match="the sensor's own position"):
        sensor(aim=LENS)


def test_measuring_along_the_viewing_direction_is_refused() -> None:
    with pytest.raises(InvalidParameter, match="the sensor's viewing direction"):
        sensor(lens=(0.0, 0.0, 0.0), aim=(0.0, 0.0, 9.0), along=(0.0, 0.0, 2.0))


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("spot_sigma_px", 0.0),
        ("spot_sigma_px", np.nan),
        ("signal_electrons", -1.0),
        ("reference_distance_mm", 0.0),
    ],
)
def test_optics_without_meaning_are_refused(field: str, value: float) -> None:
    good = {"spot_sigma_px": 2.0, "signal_electrons": 1.0, "reference_distance_mm": 1.0}
    with pytest.raises(InvalidParameter, match=f"{field} is {value}; it must be"):
        IdealOptics([sensor()], **{**good, field: value})
