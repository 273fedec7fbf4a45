"""Columns that a lens's distortion may add to a sensor's readings, for the search of labels."""

from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.calibration.labels.projective import WIDTH
from compute.calibration.labels.robust import robust_starts
from compute.calibration.labels.sensor_search import SensorReadings

Array = NDArray[np.float64]

TERMS: Final = ((3, 0), (1, 2), (0, 2), (2, 1), (0, 3))
"""Powers of u and v: what a camera does not make up for, to the third order."""
READINGS_EACH: Final = 3
"""Readings for each parameter, that a lens is thought of at all."""


def with_lens(data: SensorReadings) -> SensorReadings | None:
    """Return readings whose camera has a distortion of the third order; None for too few readings.

    The field angles u, v are those of a robust camera without distortion, from its view of the
    points' middle: close enough for the span of these columns, whose coefficients are fitted.
    """
    if len(data.seen) < READINGS_EACH * (WIDTH + len(TERMS)):
        return None
    camera = data.camera
    theta = robust_starts(camera, data.readings_px, data.sigma_px, 1)[0]
    points, slope = camera.points, theta[4:WIDTH]
    depth = 1.0 + points @ slope
    steep = float(np.linalg.norm(slope))
    along = theta[:3]
    if steep > 0.0:
        along = along - (along @ slope) * slope / steep**2
    across = np.cross(slope, along)
    length = float(np.linalg.norm(across))
    if length == 0.0:
        return None
    u = _scaled(points @ along / depth)
    v = _scaled(points @ (across / length) / depth)
    return replace(data, extra=np.column_stack([u**i * v**j for i, j in TERMS]))


def _scaled(angle: Array) -> Array:
    return np.asarray(angle / max(float(angle.std()), 1e-12))
