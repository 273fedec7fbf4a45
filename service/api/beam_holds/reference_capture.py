"""Captures a beam hold's reference from a running device, the patient set up and at rest."""

from dataclasses import replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from compute.errors import NotStationary
from compute.pose.tool_calibration.digitising import (
    StationaryPoint,
    StationarySettings,
    average_stationary_tip,
    positive_semidefinite_part,
)
from compute.transform import Transform, nearest_rotation
from service.api.beam_holds.monitor_config import REFERENCE_ARRAYS
from service.api.beam_holds.schema import NewReference
from service.pipeline.beam_hold_monitor import (
    HoldObserver,
    LitMarkerObserver,
    StrobedMarkerObserver,
    ToolObserver,
    lit_places,
)
from service.pipeline.frame_batch import FrameBatch
from service.pipeline.interface import Pipeline
from service.pipeline.tap_collection import collect
from service.pipeline.taps import SingleCalibrationTap
from service.pipeline.tracking_config import (
    Spec,
    WatchedLitMarkers,
    WatchedStrobedMarkers,
    WatchedTool,
)
from service.problems.errors import CalibrationSwitched, NoActiveCalibration, NoObservation

Array = NDArray[np.float64]

MIN_FRAMES: Final = 10
LEVER_ARM_MM: Final = 100.0
"""A tool is still when points this far from its target are."""
_NO_LIMIT: Final = 1e9


class ReferenceTap(SingleCalibrationTap):
    """Collects observations of the watched object while one calibration is active.

    Args:
        spec: what is watched.
        frames: how many of each marker, or of the pose.
    """

    def __init__(self, spec: Spec, frames: int) -> None:
        super().__init__()
        self.why: str | None = "no frame came"
        """Why the newest frame that showed not all did not."""
        self.poses: list[Transform] = []
        rows = spec.count
        self.times: list[list[int]] = [[] for _ in range(rows)]
        self.positions: list[list[Array]] = [[] for _ in range(rows)]
        self.covariances: list[list[Array]] = [[] for _ in range(rows)]
        self._spec, self._frames = spec, frames
        self._sight: HoldObserver | None = None
        if isinstance(spec, WatchedTool):
            self._sight = ToolObserver(spec)
        elif isinstance(spec, WatchedStrobedMarkers):
            self._sight = StrobedMarkerObserver(spec, np.iinfo(np.int64).max)

    def offer(self, batch: FrameBatch) -> None:
        """Collect from a batch; called where frames are processed."""
        if not self._goes_on(batch):
            return
        for index in range(len(batch.frames)):
            if self.ended.is_set():
                return
            self._take(batch, index)
            if min(map(len, self.times)) >= self._frames:
                self.ended.set()

    @property
    def frames(self) -> int:
        """Frames of the marker that was seen least, or of the pose."""
        return min(map(len, self.times))

    def _take(self, batch: FrameBatch, index: int) -> None:
        if self._sight is None:
            assert isinstance(self._spec, WatchedLitMarkers)
            seen = lit_places(self._spec, batch, index)
            if len(seen) != self._spec.markers:
                self.why = (
                    f"a frame showed {len(seen)} markers; all {self._spec.markers}, and no others, "
                    "must be in view"
                )
                return
            self._sight = LitMarkerObserver(self._spec, seen)
        shown = self._sight.of(batch, index)
        self.why = shown.why
        time_ns = batch.frames[index].exposure_device_ns
        if shown.pose is not None:
            self.times[0].append(time_ns)
            self.poses.append(shown.pose)
        if shown.positions_mm is None or shown.covariances_mm2 is None:
            return
        for row in self._rows(batch.frames[index].marker):
            if np.isfinite(shown.positions_mm[row, 0]) and len(self.times[row]) < self._frames:
                self.times[row].append(time_ns)
                self.positions[row].append(shown.positions_mm[row])
                self.covariances[row].append(shown.covariances_mm2[row])

    def _rows(self, marker: int | None) -> list[int]:
        """Return which markers a frame shows anew."""
        if not isinstance(self._spec, WatchedStrobedMarkers):
            return list(range(len(self.times)))
        return [row for row, strobed in enumerate(self._spec.markers) if strobed == marker]


def capture_reference(
    live: Pipeline, device_id: str, spec: Spec, asked: NewReference
) -> tuple[dict[str, Any], str, str | None]:
    """Measure the watched object; return the reference with the active calibration and table.

    Raises:
        DeviceNotRunning: the device does not run, or ends meanwhile.
        NoActiveCalibration: there are no places without one.
        CalibrationSwitched: another one came into force meanwhile.
        NoObservation: too few frames showed what is watched.
        NotStationary: it moved.
    """
    session = live.session(device_id)
    tap = ReferenceTap(spec, asked.frames)
    collect(live, session, tap, asked.timeout_s, tap.ended)
    if tap.switched:
        raise CalibrationSwitched(
            f'another calibration or table of device "{device_id}" was activated while the '
            "reference was measured; measure it again",
            device_id=device_id,
        )
    calibration_id, table_id = tap.active_ids or (None, None)
    if tap.active_ids is not None and calibration_id is None:
        raise NoActiveCalibration(
            f'device "{device_id}" has no active calibration, and so no places; activate one',
            device_id=device_id,
        )
    if tap.frames < asked.frames or calibration_id is None:
        raise NoObservation(
            f"{tap.frames} of {asked.frames} frames showed what is watched within "
            f"{asked.timeout_s:g} s{'' if tap.why is None else f'; the last: {tap.why}'}",
            frames=tap.frames,
        )
    if isinstance(spec, WatchedTool):
        return _of_tool(tap, spec, asked), calibration_id, table_id
    return _of_markers(tap, spec, asked), calibration_id, table_id


def _of_markers(tap: ReferenceTap, spec: Spec, asked: NewReference) -> dict[str, Any]:
    names = spec.markers if isinstance(spec, WatchedStrobedMarkers) else range(1, spec.count + 1)
    still = [
        _still(f"marker {name}", times, np.array(positions), np.array(spreads), asked)
        for name, times, positions, spreads in zip(
            names, tap.times, tap.positions, tap.covariances, strict=True
        )
    ]
    return _members(
        min(one.poses for one in still),
        max(one.sigma_mm for one in still),
        positions_mm=[one.position_mm.tolist() for one in still],
        covariances_mm2=[one.covariance_mm2.tolist() for one in still],
    )


def _of_tool(tap: ReferenceTap, spec: WatchedTool, asked: NewReference) -> dict[str, Any]:
    target = np.array(spec.target_mm)
    around = np.vstack([target, target + LEVER_ARM_MM * np.eye(3)])
    moved = np.array([pose.apply(around) for pose in tap.poses])
    names = ("its target", *(f"the point {LEVER_ARM_MM:g} mm along its {axis}" for axis in "XYZ"))
    still = [
        _still(f'tool "{spec.tool}", {name}', tap.times[0], moved[:, row], None, asked)
        for row, name in enumerate(names)
    ]
    mean = mean_pose(tap.poses)
    return _members(
        len(tap.poses),
        max(one.sigma_mm for one in still),
        rotation=mean.rotation.tolist(),
        translation_mm=mean.translation_mm.tolist(),
        covariance=None if mean.covariance is None else mean.covariance.tolist(),
    )


def mean_pose(poses: list[Transform]) -> Transform:
    """Return the mean of poses at rest.

    Its covariance is the scatter over their number, and what their own covariances say beyond
    the scatter: that is common to all of them (the calibration's), and no mean makes it smaller.
    """
    rotation = nearest_rotation(np.sum([pose.rotation for pose in poses], axis=0))
    mean = Transform(rotation, np.mean([pose.translation_mm for pose in poses], axis=0))
    off = np.array([pose.difference(mean) for pose in poses])
    scatter = off.T @ off / max(len(poses) - 1, 1)
    stated = [pose.covariance for pose in poses if pose.covariance is not None]
    covariance = scatter / len(poses)
    if stated:
        # In mm for rotations, too: else the eigenvectors would mix units.
        scale = np.array([LEVER_ARM_MM] * 3 + [1.0] * 3)
        units = scale[:, None] * scale
        excess = positive_semidefinite_part((np.mean(stated, axis=0) - scatter) * units)
        covariance = covariance + excess / units
    return replace(mean, covariance=covariance)


def _still(
    what: str, times: list[int], positions_mm: Array, spreads: Array | None, asked: NewReference
) -> StationaryPoint:
    times_ns = np.array(times, np.int64)
    span_s = max(1e-9 * float(times_ns[-1] - times_ns[0]), 1e-9)
    wanted = StationarySettings(1e-9, MIN_FRAMES, _NO_LIMIT, _NO_LIMIT, 2.0 * span_s)
    found = average_stationary_tip(times_ns, positions_mm, spreads, wanted)
    for moved, how in ((found.sigma_mm, "scattered by"), (found.drift_mm, "moved by")):
        if moved > asked.max_scatter_mm:
            raise NotStationary(
                f"{what} {how} {moved:.3g} mm over {span_s:.2f} s; it must be within "
                f"{asked.max_scatter_mm:g} mm (max_scatter_mm)",
                moved_mm=moved,
                max_mm=asked.max_scatter_mm,
            )
    return found


def _members(frames: int, scatter_mm: float, **found: Any) -> dict[str, Any]:
    none = dict.fromkeys(REFERENCE_ARRAYS)
    return {**none, **found, "kind": "captured", "frames": frames, "scatter_mm": scatter_mm}
