"""The simulated sensor bar sees its working volume, and from four different directions."""

import numpy as np
import pytest
from numpy.typing import NDArray

from compute.camera.stack import CameraStack
from hardware.simulated.scenes import CalibrationTarget, RotatingBar
from hardware.simulated.simulated_rig import (
    PIXELS,
    WORKING_CENTRE_MM,
    simulated_rig,
    simulated_sensor_models,
)

MARGIN_PX = PIXELS / 8


def readings(points_mm: NDArray[np.float64]) -> NDArray[np.float64]:
    return CameraStack.of(simulated_sensor_models()).project(points_mm)


@pytest.mark.parametrize("normal", [(0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (1.0, 0.0, 0.0)])
def test_the_whole_turn_of_the_bar_lies_inside_every_line(
    normal: tuple[float, float, float],
) -> None:
    turn = RotatingBar(plane_normal=normal).points(np.linspace(0.0, 2.0, 201)).reshape(-1, 3)
    seen = readings(turn)
    assert seen.min() > MARGIN_PX
    assert seen.max() < PIXELS - 1 - MARGIN_PX


def test_the_whole_frame_lies_inside_every_line() -> None:
    seen = readings(CalibrationTarget().points(0.0))
    assert seen.min() > MARGIN_PX
    assert seen.max() < PIXELS - 1 - MARGIN_PX
    assert (np.ptp(seen, axis=0) > PIXELS / 6).all()


def test_all_sensors_are_aimed_at_the_centre() -> None:
    np.testing.assert_allclose(readings(np.array([WORKING_CENTRE_MM])), 1023.5, atol=1e-9)


def test_each_sensor_reads_its_own_direction() -> None:
    centre = np.array(WORKING_CENTRE_MM)
    step = readings(centre + np.array([[10.0, 0, 0], [0, 10.0, 0]])) - 1023.5
    angle = np.degrees(np.arctan2(step[1], step[0]))
    # The toe-in of 11 degrees turns the directions a little, as seen in the frontal plane.
    np.testing.assert_allclose(angle, [90.0, 0.0, 45.0, -45.0], atol=2.0)


def test_three_of_the_four_sensors_are_enough_for_a_position() -> None:
    """A reading off by 0.01 px moves a point by less than 0.1 mm in any direction."""
    _, slope = CameraStack.of(simulated_sensor_models()).linearise(np.array([WORKING_CENTRE_MM]))
    for left_out in range(4):
        used = np.delete(slope[0], left_out, axis=0)
        covariance = 0.01**2 * np.linalg.inv(used.T @ used)
        assert np.sqrt(np.linalg.eigvalsh(covariance)[-1]) < 0.1


def test_the_models_are_those_of_the_placed_sensors() -> None:
    models = simulated_sensor_models()
    assert len({model.name for model in models}) == 4
    for sensor, model in zip(simulated_rig(), models, strict=True):
        lens = np.array(sensor.lens_position_mm)
        np.testing.assert_allclose(
            (model.rotation @ lens)[[0, 2]], [-model.offset_x_mm, -model.offset_z_mm], atol=1e-9
        )
        assert model.pixels == PIXELS
        assert model.principal_distance_px == pytest.approx(37.0 / 0.012)
