"""Registrations in the database: made from paired points, kept as named frames."""

from datetime import UTC, datetime
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import Select, select
from sqlalchemy.orm import Session

from compute.errors import InvalidParameter
from compute.pose.transform import Transform
from service.database.engine import insert
from service.database.models import RegistrationRow, ToolRow
from service.errors import RegistrationExists, UnknownRegistration
from service.tools.made_with import what_is_active
from service.tools.registration_schema import NewRegistration, Registration
from service.tools.schema import TRACKER
from service.tools.store import get_tool

Array = NDArray[np.float64]


def get_registration(session: Session, registration_id: str) -> RegistrationRow:
    """Return a registration; raises UnknownRegistration."""
    row = session.get(RegistrationRow, registration_id)
    if row is None:
        raise UnknownRegistration(
            f'there is no registration "{registration_id}"; GET /api/v1/registrations lists them',
            registration=registration_id,
        )
    return row


def registrations(device_id: str | None) -> Select[RegistrationRow]:
    """Return those that the filter matches, newest first."""
    found = select(RegistrationRow).order_by(RegistrationRow.created_at.desc(), RegistrationRow.id)
    return found if device_id is None else found.where(RegistrationRow.device_id == device_id)


def registered(request: NewRegistration) -> dict[str, Any]:
    """Return what the paired points give, as it is stored.

    Raises:
        CollinearPoints, DuplicatePoint, TooFewPoints, InvalidParameter, NoConvergence.
    """
    from compute.pose.registration import register_points

    pairs = request.fiducials
    names = [pair.name for pair in pairs]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise InvalidParameter(f'two fiducials are called "{twice}"; give each a name of its own')
    found = register_points(
        np.array([pair.frame_mm for pair in pairs]),
        np.array([pair.measured_mm for pair in pairs]),
        None if request.frame_sigma_mm is None else request.frame_sigma_mm**2 * np.eye(3),
        _measured_covariance(request),
        names=names,
    )
    targets = np.array([target.frame_mm for target in request.targets]).reshape(-1, 3)
    return {
        "matrix": found.transform.matrix.tolist(),
        "covariance": found.parameter_covariance[:6, :6].tolist(),
        "fre_mm": found.fre_mm,
        "fle_mm": found.fle_mm,
        "residual_sigma": found.residual_sigma,
        "fiducials": [
            {
                "name": name,
                "residual_mm": residual.tolist(),
                "error_mm": float(np.linalg.norm(residual)),
            }
            for name, residual in zip(names, found.residual_mm, strict=True)
        ],
        "targets": [
            {"name": target.name, "error_mm": float(error), "covariance_mm2": spread.tolist()}
            for target, error, spread in zip(
                request.targets,
                found.target_error(targets),
                found.target_covariance(targets),
                strict=True,
            )
        ],
        "warnings": list(found.warnings),
    }


def _measured_covariance(request: NewRegistration) -> Array | None:
    own = [pair.measured_covariance_mm2 for pair in request.fiducials]
    sigma = request.measured_sigma_mm
    if sigma is None:
        given = [one is not None for one in own]
        if not any(given):
            return None
        if not all(given):
            name = request.fiducials[given.index(False)].name
            raise InvalidParameter(
                f'fiducial "{name}" has no covariance and others have; give all of them one, or '
                "measured_sigma_mm for those without"
            )
    alike = np.eye(3) * (sigma or 0.0) ** 2
    return np.array([alike if one is None else np.array(one) for one in own])


def add_registration(
    session: Session, request: NewRegistration, result: dict[str, Any]
) -> RegistrationRow:
    """Store a registration with what is active; the device's row is locked.

    Raises:
        RegistrationExists: the id is taken, by a registration or by a tool.
        UnknownTool: the reference is none.
        InvalidParameter: the id is not to be had, or the reference is another device's.
    """
    if request.id == TRACKER:
        raise InvalidParameter(
            f'"{TRACKER}" is the name of the device\'s own frame; choose another id'
        )
    for table, what in ((RegistrationRow, "registration"), (ToolRow, "tool")):
        if session.get(table, request.id) is not None:
            raise RegistrationExists(
                f'{what} "{request.id}" exists already; choose another id',
                registration=request.id,
            )
    if request.reference is not None:
        tool = get_tool(session, request.reference)
        if tool.device_id != request.device:
            raise InvalidParameter(
                f'tool "{tool.id}" is of device "{tool.device_id}"; the reference must be of '
                f'"{request.device}"',
                reference=tool.id,
            )
    row = RegistrationRow(
        id=request.id,
        device_id=request.device,
        reference_id=request.reference,
        asked=request.model_dump(mode="json", exclude={"note"}),
        result=result | what_is_active(session, request.device),
        note=request.note,
        created_at=datetime.now(UTC),
    )
    taken = RegistrationExists(
        f'registration "{row.id}" exists already; choose another id', registration=row.id
    )
    insert(session, row, taken)
    return row


def frame_from_measured(row: RegistrationRow) -> Transform:
    """Return the transform to the frame from where its points were measured."""
    matrix = np.array(row.result["matrix"], dtype=np.float64)
    covariance = np.array(row.result["covariance"], dtype=np.float64)
    return Transform(matrix[:3, :3], matrix[:3, 3], covariance).inverse()


def document(row: RegistrationRow) -> Registration:
    """Return a registration as clients see it."""
    members = {
        "id": row.id,
        "device": row.device_id,
        "reference": row.reference_id,
        "asked": row.asked,
        "note": row.note,
        "created_at": row.created_at,
    }
    return Registration.model_validate(row.result | members)
