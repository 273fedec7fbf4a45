"""How far a reading is trusted: never further than the calibration reproduced its points."""

from dataclasses import replace
from typing import Literal

import numpy as np
import pytest

from compute.calibration.result import Calibration
from compute.calibration.run import calibrate
from compute.calibration.weights import reading_sigma
from tests.compute.rig import control_points, geometry, project, rig


def calibration(rms: float, sigma: float, source: Literal["given", "residuals"]) -> Calibration:
    models, points = rig(), control_points()
    found = calibrate(points, project(models, points), geometry(models))
    fits = [replace(f, rms_px=rms, sigma_px=sigma, sigma_source=source) for f in found.sensors]
    return replace(found, sensors=tuple(fits))


SHAPE = np.zeros((2, 4))


@pytest.mark.parametrize(
    ("rms", "own", "source", "reading", "expected"),
    [
        # Residuals as large as the stated noise: there is no misfit.
        (0.1, 0.1, "given", 0.03, 0.03),
        (0.05, 0.1, "given", 0.03, 0.03),
        # Residuals of 0.5 px where 0.3 px were stated: 0.4 px of misfit.
        (0.5, 0.3, "given", 0.3, 0.5),
        (0.5, 0.3, "given", 0.0, 0.4),
        (0.5, 0.3, "given", None, 0.5),
        (0.5, 0.3, "given", np.nan, 0.5),
        # Nothing was stated: the residuals hold noise and misfit.
        (0.5, 0.6, "residuals", 0.1, 0.6),
        (0.5, 0.6, "residuals", 2.0, 2.0),
        (0.5, 0.6, "residuals", None, 0.6),
        (0.5, 0.6, "residuals", np.nan, 0.6),
    ],
)
def test_noise_and_misfit(
    rms: float,
    own: float,
    source: Literal["given", "residuals"],
    reading: float | None,
    expected: float,
) -> None:
    given = None if reading is None else np.full(SHAPE.shape, reading)
    found = reading_sigma(calibration(rms, own, source), SHAPE, given)
    assert found == pytest.approx(np.full(SHAPE.shape, expected))
