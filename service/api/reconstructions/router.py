"""REST resource /api/v1/reconstructions."""

from typing import Annotated

from fastapi import APIRouter, Body, Path, Response
from starlette.status import HTTP_201_CREATED, HTTP_204_NO_CONTENT

from compute.errors import DuplicatePoint, ReadingOutsideSensor, UnknownSensor
from service.api.base_models import SLUG_PATTERN, Page
from service.api.calibrations.calibration_content import result_of
from service.api.correction_tables.store import content_of
from service.api.dependencies import DatabaseDep
from service.api.devices.store import get_device, sensors_of_row
from service.api.json_body import JsonRoute, JsonTypes
from service.api.openapi import problems
from service.api.pagination import PagingDep, page_of
from service.api.reconstructions import store
from service.api.reconstructions.examples import NEW_RECONSTRUCTIONS
from service.api.reconstructions.reconstruct import run_reconstruction
from service.api.reconstructions.schema import (
    NewReconstruction,
    Reconstruction,
    ReconstructionSummary,
)
from service.api.request_parameters import DeviceFilter
from service.problems.errors import (
    CalibrationOfAnotherDevice,
    CalibrationRetired,
    NoActiveCalibration,
    ReconstructionExists,
    SensorsChanged,
    UnknownCalibration,
    UnknownDevice,
    UnknownReconstruction,
)

router = APIRouter(
    prefix="/api/v1/reconstructions", tags=["reconstructions"], route_class=JsonRoute
)

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


@router.get("", operation_id="list-reconstructions", summary="List reconstructions")
def list_reconstructions(
    database: DatabaseDep, paging: PagingDep, device: DeviceFilter = None
) -> Page[ReconstructionSummary]:
    """Reconstructions without their points, newest first."""
    with database.read() as session:
        return page_of(session, store.reconstructions(device), paging, store.summary)


@router.post(
    "",
    operation_id="create-reconstruction",
    summary="Reconstruct points",
    status_code=HTTP_201_CREATED,
    responses=problems(
        UnknownDevice,
        UnknownCalibration,
        CalibrationOfAnotherDevice,
        CalibrationRetired,
        NoActiveCalibration,
        ReconstructionExists,
        SensorsChanged,
        DuplicatePoint,
        UnknownSensor,
        ReadingOutsideSensor,
    ),
)
def create_reconstruction(
    request: NewReconstructionBody, database: DatabaseDep, response: Response
) -> Reconstruction:
    """Compute points from readings of three or more sensors, each with its covariance.

    A point that cannot be had is no error: its estimate has no position and a flag that says why.
    """
    with database.read() as session:
        sensors = sensors_of_row(get_device(session, request.device))
        calibration = store.calibration_for(session, request)
        calibration_id, result = calibration.id, result_of(calibration.content)
        table = store.table_for(session, request)
        table_id = None if table is None else table.id
        corrections = None if table is None else content_of(table).table
    estimates = run_reconstruction(request.device, request.points, sensors, result, corrections)
    with database.write() as session:
        get_device(session, request.device, lock=True)
        row = store.add_reconstruction(session, request, calibration_id, table_id, estimates)
        made = store.document(row)
    response.headers["Location"] = f"/api/v1/reconstructions/{made.id}"
    return made


@router.get(
    "/{reconstruction_id}",
    operation_id="get-reconstruction",
    summary="Read a reconstruction",
    responses=problems(UnknownReconstruction),
)
def get_reconstruction(
    reconstruction_id: ReconstructionPath, database: DatabaseDep
) -> Reconstruction:
    """One reconstruction: readings and estimates."""
    with database.read() as session:
        return store.document(store.get_reconstruction(session, reconstruction_id))


@router.delete(
    "/{reconstruction_id}",
    operation_id="delete-reconstruction",
    summary="Delete a reconstruction",
    status_code=HTTP_204_NO_CONTENT,
    responses=problems(UnknownReconstruction),
)
def delete_reconstruction(reconstruction_id: ReconstructionPath, database: DatabaseDep) -> None:
    """Delete a reconstruction."""
    with database.write() as session:
        session.delete(store.get_reconstruction(session, reconstruction_id))
