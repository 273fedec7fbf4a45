"""MotionTable: points, tracks and tool poses of a sequence of frames, in columns."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

NO_MARKER: Final = -1


@dataclass(frozen=True, eq=False)
class PointRows:
    """N points, ordered by their frames.

    Args:
        frame: index of the frame of each, shape (N,).
        position_mm: shape (N, 3) [mm]; NaN: it could not be solved for.
        sd_mm: standard deviations, shape (N, 3) [mm].
        residual_sigma: root of chi2 per degree of freedom, shape (N,); NaN: there is none.
        flags: PointFlag values, shape (N,).
    """

    frame: NDArray[np.intp]
    position_mm: Array
    sd_mm: Array
    residual_sigma: Array
    flags: NDArray[np.int32]


@dataclass(frozen=True, eq=False)
class TrackRows:
    """N states of tracks, ordered by their frames.

    Args:
        frame: index of the frame of each, shape (N,).
        identity: number of the track, shape (N,).
        marker: strobe slot or code of the marker; -1: not known, shape (N,).
        state: TrackState values, shape (N,).
        flags: TrackFlag values, shape (N,).
        position_mm: shape (N, 3) [mm].
        sd_mm: standard deviations, shape (N, 3) [mm].
        velocity_mm_s: shape (N, 3) [mm/s].
    """

    frame: NDArray[np.intp]
    identity: NDArray[np.int64]
    marker: NDArray[np.int32]
    state: NDArray[np.int8]
    flags: NDArray[np.int32]
    position_mm: Array
    sd_mm: Array
    velocity_mm_s: Array


@dataclass(frozen=True, eq=False)
class PoseRows:
    """N poses, ordered by their frames; NaN where there is no pose.

    Args:
        frame: index of the frame of each, shape (N,).
        tool: index of its tool, shape (N,).
        status: PoseStatus values, as text, shape (N,).
        rotation: R_world_tool, shape (N, 3, 3).
        translation_mm: shape (N, 3) [mm].
        sd_mm: standard deviations of the translation, shape (N, 3) [mm].
        tip_mm: shape (N, 3) [mm].
        tip_sd_mm: standard deviations of the tip, shape (N, 3) [mm].
        residual_sigma: shape (N,).
    """

    frame: NDArray[np.intp]
    tool: NDArray[np.intp]
    status: NDArray[np.str_]
    rotation: Array
    translation_mm: Array
    sd_mm: Array
    tip_mm: Array
    tip_sd_mm: Array
    residual_sigma: Array


@dataclass(frozen=True, eq=False)
class MotionTable:
    """F frames of one device, and what was found in them.

    Args:
        device: its name.
        rate_hz: nominal frames per second.
        sequence: numbers of the frames, ascending, shape (F,).
        device_ns: middle of the exposures on the device's clock, shape (F,) [ns].
        host_ns: the same on the host's clock, shape (F,) [ns].
        marker: strobed marker; -1: none, shape (F,).
        points: as they were reconstructed.
        tracks: of markers.
        tools: names of the tools.
        poses: of the tools.
        notes: what else is worth knowing: which calibration, ...
    """

    device: str
    rate_hz: float
    sequence: NDArray[np.int64]
    device_ns: NDArray[np.int64]
    host_ns: NDArray[np.int64]
    marker: NDArray[np.int32]
    points: PointRows
    tracks: TrackRows
    tools: tuple[str, ...]
    poses: PoseRows
    notes: Mapping[str, str] = field(default_factory=dict)

    def __len__(self) -> int:
        """Return the number of frames."""
        return len(self.sequence)

    @property
    def time_s(self) -> Array:
        """Times of the frames on the device's clock since the first, shape (F,) [s]."""
        since = (self.device_ns - self.device_ns[:1]).astype(np.float64)
        return since * 1e-9
