"""REST resource /api/v1/reconstructions."""

from typing import Annotated

from fastapi import APIRouter, Body, Path, Response
from starlette.status import HTTP_201_CREATED, HTTP_204_NO_CONTENT

from compute.errors import DuplicatePoint, ReadingOutsideSensor, UnknownSensor
from service.calibrations.run import result_of
from service.correction_tables.store import content_of
from service.dependencies import DatabaseDep
from service.devices.store import get_device, sensors_of_row
from service.errors import (
    CalibrationOfAnotherDevice,
    CalibrationRetired,
    NoActiveCalibration,
    ReconstructionExists,
    SensorsChanged,
    UnknownCalibration,
    UnknownDevice,
    UnknownReconstruction,
)
from service.json_body import FromJson, JsonRoute
from service.openapi import problems
from service.pages import PagingDep, page_of
from service.parameters import DeviceFilter
from service.reconstructions import store
from service.reconstructions.examples import NEW_RECONSTRUCTIONS
from service.reconstructions.run import run_reconstruction
from service.reconstructions.schema import (
    NewReconstruction,
    Reconstruction,
    ReconstructionSummary,
)
from service.schema import SLUG_PATTERN, Page

router = APIRouter(
    prefix="/api/v1/reconstructions", tags=["reconstructions"], route_class=JsonRoute
)

NewReconstructionBody = Annotated[
    NewReconstruction, FromJson(), Body(openapi_examples=NEW_RECONSTRUCTIONS)
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
