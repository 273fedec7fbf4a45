"""Distortion "auto" without any candidate that can be cross-validated: no terms, with reasons."""

import numpy as np
import pytest
from numpy.typing import NDArray

from compute.calibration.assessment.assess import calibrate_and_assess
from compute.calibration.distortion_selection import refusals
from compute.calibration.settings import AUTO_CANDIDATES, CalibrationSettings
from compute.camera.model import SensorGeometry
from tests.compute.rig import geometry, project, rig
from validation.thesis_data import load_test

Array = NDArray[np.float64]
Data = tuple[Array, Array, list[SensorGeometry]]

CENTRE_MM = np.array([0.0, 0.0, 1500.0])


def measured_frame() -> Data:
    """Test 5.3 as someone enters it who has no more than the pixels' pitch."""
    test = load_test("5.3")
    names = [f"cam{number}" for number in range(1, 5)]
    return (
        test.points_mm,
        np.asarray(test.readings_mm) / 0.0127,
        [SensorGeometry(name, 640) for name in names],
    )


def cube_corners() -> Data:
    corners = np.array(np.meshgrid(*[[-250.0, 250.0]] * 3, indexing="ij")).reshape(3, 8).T
    return read_with_noise(CENTRE_MM + corners, 0.05, np.random.default_rng(0))


def slab() -> Data:
    """Sixteen points within 2 mm of a plane."""
    rng = np.random.default_rng(0)
    offsets = rng.uniform(-1.0, 1.0, (16, 3)) * [250.0, 250.0, 1.0]
    return read_with_noise(CENTRE_MM + offsets, 0.05, rng)


def nine_of_sixteen() -> Data:
    """The second sensor saw the nine nearest points only."""
    rng = np.random.default_rng(0)
    points = CENTRE_MM + rng.uniform(-250.0, 250.0, (16, 3))
    points, readings, sensors = read_with_noise(points, 1.0, rng)
    readings[points[:, 2].argsort()[9:], 1] = np.nan
    return points, readings, sensors


def read_with_noise(points: Array, sigma_px: float, rng: np.random.Generator) -> Data:
    readings = project(rig(), points)
    return points, readings + sigma_px * rng.standard_normal(readings.shape), geometry(rig())


@pytest.mark.slow
@pytest.mark.parametrize("data", [measured_frame, cube_corners, slab, nine_of_sixteen])
def test_auto_takes_none_and_says_why_where_no_candidate_is_judged(data) -> None:
    given = data()
    found = calibrate_and_assess(*given, settings=CalibrationSettings("auto"))
    chosen = found.distortion
    assert chosen is not None
    assert chosen.chosen == "none"
    assert [one.name for one in chosen.candidates] == ["none", *AUTO_CANDIDATES]
    for one in chosen.candidates:
        assert one.note
        assert one.loss is None
    assert "no candidate could be judged" in chosen.reason
    assert chosen.candidates[0].note in chosen.reason
    named = [name for names in refusals(chosen.candidates).values() for name in names]
    assert sorted(named) == sorted(["none", *AUTO_CANDIDATES])
    # As if no distortion had been asked for.
    plain = calibrate_and_assess(*given, settings=CalibrationSettings("none"))
    assert found.models == plain.models
    assert found.covariance == plain.covariance
