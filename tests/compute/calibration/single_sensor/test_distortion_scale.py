"""The scale of the distortion of a device's lenses."""

import numpy as np
import pytest

from compute.calibration.single_sensor.distortion_scale import STRENGTHS, fit_distortion_scale
from compute.calibration.single_sensor.sensor_fits import ControlObservations
from compute.calibration.single_sensor.undistorted_fit import fit_undistorted
from compute.camera.model import SensorGeometry
from tests.compute.rig import control_points, geometry, project, rig


def test_copies_of_a_lens_count_as_the_root_of_their_number() -> None:
    """Two posteriors of the scale give the evidence, and so that of any number of copies."""
    points = control_points(14)
    readings = project(rig(), points)[:, :1]
    readings += 0.3 * np.random.default_rng(2).standard_normal(readings.shape)

    def fit(copies: int) -> tuple[float, float]:
        sensors = [SensorGeometry(f"s{k}", 2048) for k in range(copies)]
        copied = np.tile(readings, copies)
        observed = ControlObservations.of(points, copied, sensors, np.full(copied.shape, 0.3))
        plain = fit_undistorted(observed, "linear")
        found = fit_distortion_scale(observed, plain, "linear")[1]
        assert found.scale is not None
        assert found.log_evidence_ratio is not None
        return found.scale, found.log_evidence_ratio

    (one, ratio), (four, summed), (sixteen, _) = fit(1), fit(4), fit(16)
    assert summed == pytest.approx(4.0 * ratio, abs=1e-6)
    # The readings say little, so that the posterior narrows slowly with the number of copies.
    flat = float(np.sqrt((STRENGTHS**2).mean()))
    assert flat > one > four > sixteen > 0.3 * one


@pytest.mark.slow
def test_noise_of_few_readings_is_not_taken_for_distortion() -> None:
    """Each scale has noise of its own: with one noise for all, small noise and large scale win."""
    sensors = geometry(rig())
    for seed in (0, 1, 2, 10):
        points = control_points(11, seed)
        exact = project(rig(), points)
        readings = exact + 0.8 * np.random.default_rng(seed).standard_normal(exact.shape)
        observed = ControlObservations.of(points, readings, sensors, None)
        plain = fit_undistorted(observed, "linear")
        fits, found = fit_distortion_scale(observed, plain, "linear")
        assert fits.unit_px is not None
        assert 0.5 < np.sqrt((fits.unit_px**2).mean()) < 1.2
        assert found.log_evidence_ratio is not None
        assert found.log_evidence_ratio < 2.0
