"""The scale of the distortion of a device's lenses."""

import numpy as np
import pytest

from compute.calibration.single_sensor.distortion_scale import fit_distortion_scale
from compute.calibration.single_sensor.sensor_fits import ControlObservations, fit_undistorted
from compute.camera.model import SensorGeometry
from tests.compute.rig import control_points, project, rig


def test_copies_of_a_lens_tell_no_more_of_the_scale_than_the_lens() -> None:
    points = control_points(14)
    readings = project(rig(), points)[:, :3]
    readings += 0.3 * np.random.default_rng(2).standard_normal(readings.shape)
    estimates = []
    for copies in (1, 3):
        sensors = [SensorGeometry(f"s{k}", 2048) for k in range(3 * copies)]
        copied = np.tile(readings, copies)
        observed = ControlObservations.of(points, copied, sensors, np.full(copied.shape, 0.3))
        plain = fit_undistorted(observed, "linear")
        estimates.append(fit_distortion_scale(observed, plain, "linear")[1])
    lenses, copies_of_them = estimates
    assert lenses.scale == pytest.approx(copies_of_them.scale, rel=1e-6)
    assert lenses.scale_range == copies_of_them.scale_range
    # It is not settled by the readings, so that more evidence would move it.
    low, high = lenses.scale_range or (0.0, 0.0)
    assert high > 3.0 * low
