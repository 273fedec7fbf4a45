"""Stored beam holds and tools as the configuration that the pipeline tracks and monitors."""

import json
from datetime import datetime
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter
from sqlalchemy import select
from sqlalchemy.orm import Session

from compute.errors import InvalidParameter
from compute.pose.beam_hold import BeamHoldLimits, BeamHoldTiming
from compute.transform import Transform
from service.api.beam_holds.schema import (
    Limits,
    ReferenceInput,
    Rules,
    SimultaneousMarkersWatch,
    ToolWatch,
    Watch,
)
from service.api.devices.store import tracking_of
from service.api.tools.rigid_bodies import tools_of
from service.database.models import DeviceRow, HoldRow
from service.pipeline.tracking_config import (
    BeamHoldConfig,
    HoldReference,
    Spec,
    TrackingConfig,
    WatchedLitMarkers,
    WatchedStrobedMarkers,
    WatchedTool,
)

MIN_APART_MM: Final = 1.0
"""Of markers: two lights that are nearer to each other are seen as one."""
REFERENCE_ARRAYS: Final = (
    "rotation",
    "translation_mm",
    "covariance",
    "positions_mm",
    "covariances_mm2",
)
"""Members of a stored reference that are arrays."""
_WATCH: TypeAdapter[Watch] = TypeAdapter(Watch)


def to_watch(row: HoldRow) -> Watch:
    """Return what a hold watches."""
    return _WATCH.validate_python(row.watch)


def to_spec(watch: Watch) -> Spec:
    """Return the same as the live side has it.

    Raises:
        InvalidParameter: it contradicts itself.
    """
    if isinstance(watch, ToolWatch):
        if watch.axes is not None:
            Transform(np.array(watch.axes), np.zeros(3))
        return WatchedTool(watch.tool_id, watch.target_mm, watch.axes)
    count = watch.markers if isinstance(watch, SimultaneousMarkersWatch) else len(watch.markers)
    least = count if watch.min_markers is None else watch.min_markers
    if least > count:
        raise InvalidParameter(f"min_markers is {least}, and {count} are watched")
    if isinstance(watch, SimultaneousMarkersWatch):
        return WatchedLitMarkers(count, least, watch.search_radius_mm, watch.observed_as)
    if len(set(watch.markers)) != count:
        raise InvalidParameter(f"markers is {list(watch.markers)}; name each marker once")
    return WatchedStrobedMarkers(tuple(watch.markers), least)


def to_limits(limits: Limits, rules: Rules, watch: Watch) -> BeamHoldLimits:
    """Return limits and rules as monitors have them.

    Raises:
        InvalidParameter: there is no limit, or one that means nothing for what is watched.
    """
    found = BeamHoldLimits(
        limits.shift_mm,
        limits.axis_mm,
        limits.rotation_rad,
        limits.probability,
        limits.release,
        BeamHoldTiming(round(rules.max_gap_s * 1e9), round(rules.settle_s * 1e9), rules.latched),
    )
    if not isinstance(watch, ToolWatch) and limits.rotation_rad is not None:
        raise InvalidParameter(
            f"rotation_rad is {limits.rotation_rad}, and markers do not turn; leave it out, or "
            "watch a tool"
        )
    if isinstance(watch, SimultaneousMarkersWatch):
        most = max(limits.shift_mm or 0.0, *(limits.axis_mm or (0.0,)), 0.0)
        if watch.search_radius_mm <= most:
            raise InvalidParameter(
                f"search_radius_mm is {watch.search_radius_mm:g} mm and a limit {most:g} mm; "
                "markers must be looked for farther away than they may move"
            )
    return found


def validate_reference(given: ReferenceInput, watch: Watch) -> dict[str, Any]:
    """Validate a reference that a client gives; return its members as they are stored.

    Raises:
        InvalidParameter: it is not one of what is watched.
    """
    pose, positions = (given.rotation, given.translation_mm), given.positions_mm
    if isinstance(watch, ToolWatch):
        if None in pose or positions is not None:
            raise InvalidParameter(
                "the reference of a tool is its pose: give rotation and translation_mm, and no "
                "positions_mm"
            )
        Transform(np.array(given.rotation), np.array(given.translation_mm))
        if given.covariance is not None:
            _check_covariance(np.array(given.covariance))
    else:
        if positions is None or (*pose, given.covariance) != (None, None, None):
            raise InvalidParameter(
                "the reference of markers is their places: give positions_mm, and neither "
                "rotation, translation_mm nor covariance"
            )
        if len(positions) != (count := to_spec(watch).count):
            raise InvalidParameter(
                f"positions_mm has {len(positions)} places; {count} markers are watched"
            )
        _check_apart(np.array(positions))
    return {
        **given.model_dump(mode="json"),
        "covariances_mm2": None,
        "kind": "given",
        "frames": None,
        "scatter_mm": None,
    }


def _check_apart(positions_mm: NDArray[np.float64]) -> None:
    apart = np.linalg.norm(positions_mm[:, None] - positions_mm, axis=2)
    close = np.argwhere(np.triu(apart < MIN_APART_MM, 1))
    if len(close):
        one, other = close[0].tolist()
        raise InvalidParameter(
            f"positions_mm has two markers at one place: {one + 1} and {other + 1} are "
            f"{apart[one, other]:.3g} mm apart; at least {MIN_APART_MM:g} mm are needed"
        )


def _check_covariance(given: NDArray[np.float64]) -> None:
    scale = float(np.abs(given).max())
    least = float(np.linalg.eigvalsh(0.5 * (given + given.T))[0])
    if np.abs(given - given.T).max() > 1e-9 * scale or least < -1e-9 * scale:
        raise InvalidParameter(
            "covariance is none: it must be symmetric, and no eigenvalue negative; the smallest "
            f"is {least:.3g}"
        )


def to_watched_hold(row: HoldRow) -> BeamHoldConfig:
    """Return a stored hold as the live side watches it."""
    watch = to_watch(row)
    limits, rules = Limits.model_validate(row.limits), Rules.model_validate(row.rules)
    members = [row.watch, row.limits, row.rules, row.reference]
    return BeamHoldConfig(
        row.id,
        row.device_id,
        json.dumps(members, sort_keys=True),
        to_spec(watch),
        to_limits(limits, rules, watch),
        None if row.reference is None else _reference(row.reference),
    )


def _reference(stored: dict[str, Any]) -> HoldReference:
    rotation, translation, covariance, positions, covariances = (
        None if stored[name] is None else np.array(stored[name], np.float64)
        for name in REFERENCE_ARRAYS
    )
    pose = None
    if rotation is not None and translation is not None:
        pose = Transform(rotation, translation, covariance)
    return HoldReference(
        stored["id"],
        datetime.fromisoformat(stored["set_at"]),
        stored["calibration_id"],
        stored["table_id"],
        pose,
        positions,
        covariances,
    )


def beam_holds_of(session: Session, device_id: str) -> tuple[BeamHoldConfig, ...]:
    """Return all holds of a device, by id."""
    rows = select(HoldRow).where(HoldRow.device_id == device_id).order_by(HoldRow.id)
    return tuple(to_watched_hold(row) for row in session.scalars(rows))


def tracking_config_of(session: Session, device: DeviceRow) -> TrackingConfig:
    """Return what a running device tracks: tools, beam holds, and whether it makes tracks.

    A beam hold that goes by tracks has markers followed, whatever the settings say.
    """
    tracking, tools = tracking_of(device), tools_of(session, device.id)
    holds = beam_holds_of(session, device.id)
    tracks = tracking.tracks == "always" or (tracking.tracks == "with-tools" and bool(tools))
    tracks |= any(
        isinstance(one.spec, WatchedLitMarkers) and one.spec.observed_as == "tracks"
        for one in holds
    )
    codes = None if tracking.blinking is None else tracking.blinking.codes()
    return TrackingConfig(tracks, tools, tracking.tracker(), tracking.tool_tracker(), codes, holds)
