"""Reconstructs the points of a request with a stored calibration."""

from collections.abc import Sequence

import numpy as np

from compute.calibration.result import Calibration
from compute.calibration.weights import reading_sigma
from compute.reconstruction.points import reconstruct
from hardware.driver import SensorDescription
from service.calibrations.observations import observations
from service.calibrations.sensors import check_sensors
from service.reconstructions.schema import NamedEstimate, ObservedPoint


def run_reconstruction(
    device_id: str,
    points: Sequence[ObservedPoint],
    sensors: Sequence[SensorDescription],
    calibration: Calibration,
) -> list[NamedEstimate]:
    """Return the estimates, the calibration's covariance included.

    Readings without a standard deviation get the calibration's for their sensor; none is trusted
    further than the calibration reproduced its control points.

    Raises:
        SensorsChanged: the calibration is of other sensors than the device's.
        DuplicatePoint, UnknownSensor, ReadingOutsideSensor: what is wrong with the readings.
    """
    check_sensors(device_id, sensors, calibration.models)
    observed = observations(points, sensors)
    sigma = reading_sigma(calibration, observed.readings_px, observed.sigma_px)
    batch = reconstruct(
        calibration.models, observed.readings_px, sigma, np.array(calibration.covariance)
    )
    names = tuple(sensor.name for sensor in sensors)
    return [
        NamedEstimate(**vars(estimate), name=point.name)
        for estimate, point in zip(batch.estimates(names), points, strict=True)
    ]
