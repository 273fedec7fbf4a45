"""Standard deviations of readings: at least the calibration's model error."""

from dataclasses import replace
from typing import Literal

import numpy as np
import pytest

from compute.calibration.calibrate import calibrate
from compute.calibration.result import Calibration, measurement_sigma
from tests.compute.rig import control_points, geometry, project, rig

Source = Literal["given", "residuals", "assumed"]


def calibration(chi2: float | None, sigma: float, source: Source) -> Calibration:
    models, points = rig(), control_points()
    found = calibrate(points, project(models, points), geometry(models))
    fits = [
        replace(f, chi2_per_dof=chi2, sigma_px=sigma, sigma_source=source) for f in found.sensors
    ]
    return replace(found, sensors=tuple(fits))


SHAPE = np.zeros((2, 4))


@pytest.mark.parametrize(
    ("chi2", "own", "source", "reading", "expected"),
    [
        # Residuals as large as the stated noise, or smaller, or unknown: there is no misfit.
        (1.0, 0.1, "given", 0.03, 0.03),
        (0.3, 0.1, "given", 0.03, 0.03),
        (None, 0.1, "given", 0.03, 0.03),
        # Residuals of 0.5 px where 0.3 px were stated: 0.4 px of misfit.
        (25 / 9, 0.3, "given", 0.3, 0.5),
        (25 / 9, 0.3, "given", 0.0, 0.4),
        (25 / 9, 0.3, "given", None, 0.5),
        (25 / 9, 0.3, "given", np.nan, 0.5),
        # Nothing was stated: the residuals hold noise and misfit.
        (None, 0.6, "residuals", 0.1, 0.6),
        (None, 0.6, "residuals", 2.0, 2.0),
        (None, 0.6, "residuals", None, 0.6),
        (None, 0.6, "residuals", np.nan, 0.6),
        # Nothing is known of it: a reading's own deviation counts.
        (None, 0.3, "assumed", 0.01, 0.01),
        (None, 0.3, "assumed", None, 0.3),
    ],
)
def test_noise_and_misfit(
    chi2: float | None,
    own: float,
    source: Source,
    reading: float | None,
    expected: float,
) -> None:
    given = None if reading is None else np.full(SHAPE.shape, reading)
    found = measurement_sigma(calibration(chi2, own, source), SHAPE, given)
    assert found == pytest.approx(np.full(SHAPE.shape, expected))
