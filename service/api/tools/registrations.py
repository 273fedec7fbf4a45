"""Registrations in the database: named frames."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Any, Final

import numpy as np
from pydantic import TypeAdapter
from sqlalchemy.orm import Session

from compute.errors import InvalidParameter
from compute.transform import Transform
from service.api.base_models import Position, from_attributes
from service.api.tools.dependency_check import Dependencies
from service.api.tools.provenance import active_ids, provenance
from service.api.tools.registration_schema import (
    NewPairedPoints,
    NewSurface,
    NewThreeMarkers,
    Registration,
    StoredRequest,
    Target,
)
from service.api.tools.store import TOOLS, check_free
from service.database.engine import Resource
from service.database.models import RegistrationRow
from service.problems.errors import CalibrationSwitched, RegistrationExists, UnknownRegistration

NewAny = NewPairedPoints | NewThreeMarkers | NewSurface

_ASKED: Final[TypeAdapter[Any]] = TypeAdapter(StoredRequest)


REGISTRATIONS: Final = Resource(
    RegistrationRow,
    "registration",
    UnknownRegistration,
    RegistrationExists,
    taken="exists already; choose another id",
)


@dataclass(frozen=True, eq=False)
class NewRegistrationRecord:
    """A registration that was computed, to be stored.

    Args:
        result: what was found.
        asked: what is kept of the request.
        reference: the tool that the points were measured relative to; None: the tracker.
        measured_with: active calibration and table when they were, where that is known; None:
            what is active when it is stored.
        relied_on: what it was found from by name, while that took its time.
    """

    result: dict[str, Any]
    asked: dict[str, Any]
    reference: str | None
    measured_with: tuple[str | None, str | None] | None = None
    dependencies: Dependencies = field(default_factory=Dependencies)


def check_new(session: Session, request: NewAny, reference: str | None) -> None:
    """Check the name and the reference of a new registration.

    Raises:
        RegistrationExists: the id is taken, by a registration or by a tool.
        UnknownTool: the reference is none.
        InvalidParameter: the id is not to be had, or the reference is another device's.
    """
    check_free(session, request.id, REGISTRATIONS)
    if reference is not None:
        tool = TOOLS.get(session, reference)
        if tool.device_id != request.device_id:
            raise InvalidParameter(
                f'tool "{tool.id}" is of device "{tool.device_id}"; the reference must be of '
                f'"{request.device_id}"',
                reference_id=tool.id,
            )


def check_parent(session: Session, request: NewSurface, parent: RegistrationRow) -> None:
    """Check that a registration can be refined, and the name of the new one.

    Raises:
        RegistrationExists: the new id is taken.
        InvalidParameter: it is another device's, or its frame does not hold with what is active.
    """
    check_new(session, request, None)
    if parent.device_id != request.device_id:
        raise InvalidParameter(
            f'registration "{parent.id}" is of device "{parent.device_id}", not of '
            f'"{request.device_id}"; name one of the same device',
            parent=parent.id,
        )
    active = active_ids(session, request.device_id)
    why = provenance(session, parent).invalid_reason(active["calibration_id"], active["table_id"])
    if why is not None:
        raise InvalidParameter(f"{why}, and refine that one", parent=parent.id)


def add_registration(
    session: Session, request: NewAny, made: NewRegistrationRecord
) -> RegistrationRow:
    """Store a registration with the active calibration and table; locks the device's row.

    Raises:
        CalibrationSwitched: what its points were measured with is active no more.
        RegistrationExists, UnknownTool, InvalidParameter: as ``check_new``.
        ToolReplaced, RegistrationReplaced: what it was found from is another by now.
    """
    check_new(session, request, made.reference)
    made.dependencies.check(session)
    active = active_ids(session, request.device_id)
    if made.measured_with not in (None, (active["calibration_id"], active["table_id"])):
        raise CalibrationSwitched(
            f'another calibration or table of device "{request.device_id}" was activated while '
            f'registration "{request.id}" was made; do it again',
            device_id=request.device_id,
        )
    row = RegistrationRow(
        id=request.id,
        device_id=request.device_id,
        reference_id=made.reference,
        asked=made.asked,
        result=made.result | active,
        note=request.note,
        created_at=datetime.now(UTC),
    )
    return REGISTRATIONS.insert(session, row)


def frame_from_measured(row: RegistrationRow) -> Transform:
    """Return the transform to the frame from where its points were measured."""
    matrix = np.array(row.result["matrix"], dtype=np.float64)
    covariance = np.array(row.result["covariance"], dtype=np.float64)
    return Transform(matrix[:3, :3], matrix[:3, 3], covariance).inverse()


def measured_points(row: RegistrationRow) -> list[tuple[str, Position]]:
    """Return the names and positions of the points of a registration.

    In the tracker's frame, or that of its reference tool; points on a surface have no names.
    """
    asked = _ASKED.validate_python(row.asked)
    if isinstance(asked, NewPairedPoints):
        return [(one.name, one.measured_mm) for one in asked.fiducials]
    markers = document(row).markers
    return [(one.name, one.measured_mm) for one in markers]


def document(row: RegistrationRow) -> Registration:
    """Return a registration as clients see it."""
    kind = row.asked.get("kind", "paired-points")
    return from_attributes(Registration, row, **row.result, kind=kind, request=row.asked)


def target_errors(
    targets: Sequence[Target], measured_from_frame: Transform
) -> list[dict[str, Any]]:
    """Return the members of TargetError, by the covariance of the transform.

    Args:
        targets: places in the frame.
        measured_from_frame: the registration, with its covariance.
    """
    places = np.array([target.frame_mm for target in targets]).reshape(-1, 3)
    return [
        {
            "name": target.name,
            "error_mm": float(np.sqrt(np.trace(spread))),
            "covariance_mm2": spread.tolist(),
        }
        for target, spread in zip(
            targets, measured_from_frame.point_covariance(places), strict=True
        )
    ]
