"""Reconstructs the points of a request with a stored calibration."""

from collections.abc import Sequence

import numpy as np

from compute.calibration.measurement_noise import measurement_sigma
from compute.calibration.result import Calibration
from compute.mapping.table import CorrectionTable
from compute.reconstruction.triangulation import reconstruct
from hardware.driver import SensorDescription
from service.api.calibrations.observations import observations
from service.api.calibrations.sensor_check import check_sensors
from service.api.reconstructions.schema import NamedEstimate, ObservedPoint


def run_reconstruction(
    device_id: str,
    points: Sequence[ObservedPoint],
    sensors: Sequence[SensorDescription],
    calibration: Calibration,
    table: CorrectionTable | None = None,
) -> list[NamedEstimate]:
    """Return the estimates, the calibration's covariance included.

    With a correction table the readings are corrected by it: its variance holds what the
    calibration's covariance and misfit are without it.

    Readings without a standard deviation get the calibration's for their sensor; none is trusted
    further than the calibration reproduced its control points.

    Raises:
        SensorsChanged: the calibration is of other sensors than the device's.
        DuplicatePoint, UnknownSensor, ReadingOutsideSensor: what is wrong with the readings.
    """
    check_sensors(device_id, sensors, calibration.models)
    observed = observations(points, sensors)
    sigma = measurement_sigma(calibration, observed.readings_px, observed.sigma_px)
    covariance = np.array(calibration.covariance) if table is None else None
    if table is not None:
        sigma = np.where(np.isfinite(observed.sigma_px), observed.sigma_px, sigma)
    batch = reconstruct(calibration.models, observed.readings_px, sigma, covariance, table)
    names = tuple(sensor.name for sensor in sensors)
    return [
        NamedEstimate(**vars(estimate), name=point.name)
        for estimate, point in zip(batch.estimates(names), points, strict=True)
    ]
