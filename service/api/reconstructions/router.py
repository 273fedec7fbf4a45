"""REST resource /api/v1/reconstructions."""

from collections.abc import Sequence
from itertools import compress
from math import isfinite
from typing import Annotated

import numpy as np
from fastapi import Body, Path, Response
from numpy.typing import NDArray

from compute.calibration.result import Calibration, measurement_sigma
from compute.mapping.table import CorrectionTable
from compute.measurement.measurement_model import MeasurementModel
from compute.reconstruction.outlier_exclusion import exclude_outliers
from compute.reconstruction.point_batch import PointBatch
from compute.reconstruction.triangulation import detectable_errors, reconstruct
from hardware.driver import SensorDescription
from service.api.base_models import SLUG_PATTERN
from service.api.calibrations.calibration_content import observations, result_of
from service.api.correction_tables.store import content_of
from service.api.devices.schema import check_sensors
from service.api.devices.store import get_device, sensors_of_row
from service.api.inputs import DatabaseDep, DeviceFilter, JsonTypes
from service.api.openapi import ResourceRouter, raises
from service.api.paging import Page, PagingDep, page_of
from service.api.reconstructions import store
from service.api.reconstructions.examples import NEW_RECONSTRUCTIONS
from service.api.reconstructions.schema import (
    NamedEstimate,
    NewReconstruction,
    ObservedPoint,
    Reconstruction,
    ReconstructionSummary,
)

Array = NDArray[np.float64]

router = ResourceRouter("/api/v1/reconstructions", "reconstructions")

NewReconstructionBody = Annotated[
    NewReconstruction, JsonTypes(), Body(openapi_examples=NEW_RECONSTRUCTIONS)
]
ReconstructionPath = Annotated[
    str,
    Path(
        pattern=SLUG_PATTERN,
        description="The reconstruction's id.",
        openapi_examples={"check": {"summary": "of the example body", "value": "sim-check"}},
    ),
]


@router.operation("GET", "list-reconstructions", "List reconstructions")
def list_reconstructions(
    database: DatabaseDep, paging: PagingDep, device_id: DeviceFilter = None
) -> Page[ReconstructionSummary]:
    """Reconstructions without their points, newest first."""
    with database.read() as session:
        return page_of(session, store.reconstructions(device_id), paging, store.summary)


@router.operation("POST", "create-reconstruction", "Reconstruct points", status_code=201)
@raises("unknown-device", "unknown-calibration", "calibration-of-another-device")
@raises("calibration-retired", "no-active-calibration", "reconstruction-exists", "sensors-changed")
@raises("duplicate-point", "unknown-sensor", "reading-outside-sensor")
def create_reconstruction(
    request: NewReconstructionBody, database: DatabaseDep, response: Response
) -> Reconstruction:
    """Compute points from readings of three or more sensors, each with its covariance.

    A point that cannot be had is no error: its estimate has no position and a flag that says why.
    """
    with database.read() as session:
        sensors = sensors_of_row(get_device(session, request.device_id))
        calibration = store.calibration_for(session, request)
        calibration_id, result = calibration.id, result_of(calibration.content)
        table = store.table_for(session, request)
        table_id = None if table is None else table.id
        corrections = None if table is None else content_of(table).table
    estimates = run_reconstruction(request.device_id, request.points, sensors, result, corrections)
    with database.write() as session:
        get_device(session, request.device_id, lock=True)
        row = store.add_reconstruction(session, request, calibration_id, table_id, estimates)
        made = store.with_points(row, request.points, estimates)
    response.headers["Location"] = f"/api/v1/reconstructions/{made.id}"
    return made


@router.operation("GET /{reconstruction_id}", "get-reconstruction", "Read a reconstruction")
@raises("unknown-reconstruction")
def get_reconstruction(
    reconstruction_id: ReconstructionPath, database: DatabaseDep
) -> Reconstruction:
    """One reconstruction: readings and estimates."""
    with database.read() as session:
        return store.document(store.RECONSTRUCTIONS.get(session, reconstruction_id))


@router.operation("DELETE /{reconstruction_id}", "delete-reconstruction", "Delete a reconstruction")
@raises("unknown-reconstruction")
def delete_reconstruction(reconstruction_id: ReconstructionPath, database: DatabaseDep) -> None:
    """Delete a reconstruction."""
    with database.write() as session:
        session.delete(store.RECONSTRUCTIONS.get(session, reconstruction_id))


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
    further than the calibration reproduced its control points. A reading that contradicts the
    others is left out where five sensors or more tell which it is.

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
    model = MeasurementModel.of(calibration.models, covariance, table)

    def solve(readings_px: Array, sigma_px: Array) -> PointBatch:
        return reconstruct(model.cameras, readings_px, sigma_px, covariance, table)

    whole = solve(observed.readings_px, sigma)
    batch = exclude_outliers(solve, whole, observed.readings_px, sigma)
    detectable_px = detectable_errors(model, batch, observed.readings_px, sigma)
    names = tuple(sensor.name for sensor in sensors)
    return [
        NamedEstimate(
            **vars(estimate),
            name=point.name,
            excluded=tuple(compress(names, excluded)),
            detectable_px={
                name: value if isfinite(value) else None
                for name, value, used in zip(names, detectable, used_here, strict=True)
                if used
            },
        )
        for estimate, point, excluded, used_here, detectable in zip(
            batch.estimates(names),
            points,
            (whole.used & ~batch.used).tolist(),
            batch.used.tolist(),
            detectable_px.tolist(),
            strict=True,
        )
    ]
