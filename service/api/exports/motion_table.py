"""MotionTable: points, tracks and tool poses of a sequence of frames, in columns."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Any, Final, Self

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

NO_MARKER: Final = -1


@dataclass(frozen=True, eq=False)
class _Rows:
    """N rows, ordered by their frames: index of the frame of each, shape (N,)."""

    frame: NDArray[np.intp]

    @classmethod
    def concatenate(cls, parts: Sequence[Self]) -> Self:
        """Return the rows of all parts, in the types of the first."""
        columns = ([getattr(part, one.name) for part in parts] for one in fields(cls))
        return cls(*(np.concatenate(column).astype(column[0].dtype) for column in columns))


@dataclass(frozen=True, eq=False)
class PointRows(_Rows):
    """Points.

    Args:
        position_mm: shape (N, 3) [mm]; NaN: it could not be solved for.
        sd_mm: standard deviations, shape (N, 3) [mm].
        residual_sigma: root of chi2 per degree of freedom, shape (N,); NaN: there is none.
        flags: PointFlag values, shape (N,).
    """

    position_mm: Array
    sd_mm: Array
    residual_sigma: Array
    flags: NDArray[np.int32]


@dataclass(frozen=True, eq=False)
class TrackRows(_Rows):
    """States of tracks.

    Args:
        identity: number of the track, shape (N,).
        marker: strobe slot or code of the marker; -1: not known, shape (N,).
        state: TrackState values, shape (N,).
        flags: TrackFlag values, shape (N,).
        position_mm: shape (N, 3) [mm].
        sd_mm: standard deviations, shape (N, 3) [mm].
        velocity_mm_s: shape (N, 3) [mm/s].
    """

    identity: NDArray[np.int64]
    marker: NDArray[np.int32]
    state: NDArray[np.int8]
    flags: NDArray[np.int32]
    position_mm: Array
    sd_mm: Array
    velocity_mm_s: Array


@dataclass(frozen=True, eq=False)
class PoseRows(_Rows):
    """Poses; NaN where there is no pose.

    Args:
        tool: index of its tool, shape (N,).
        status: PoseStatus values, as text, shape (N,).
        rotation: R_world_tool, shape (N, 3, 3).
        translation_mm: shape (N, 3) [mm].
        sd_mm: standard deviations of the translation, shape (N, 3) [mm].
        tip_mm: shape (N, 3) [mm].
        tip_sd_mm: standard deviations of the tip, shape (N, 3) [mm].
        residual_sigma: shape (N,).
    """

    tool: NDArray[np.intp]
    status: NDArray[np.str_]
    rotation: Array
    translation_mm: Array
    sd_mm: Array
    tip_mm: Array
    tip_sd_mm: Array
    residual_sigma: Array


_NUMBERS: Final = np.empty(0)
_VECTORS: Final = np.empty((0, 3))
NO_POINTS: Final = PointRows(
    np.empty(0, np.intp), _VECTORS, _VECTORS, _NUMBERS, np.empty(0, np.int32)
)
NO_TRACKS: Final = TrackRows(
    np.empty(0, np.intp), np.empty(0, np.int64), np.empty(0, np.int32), np.empty(0, np.int8),
    np.empty(0, np.int32), _VECTORS, _VECTORS, _VECTORS,
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class MotionTable:
    """Points, tracks and poses of F frames of one device.

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


def stack_or_nan(values: Iterable[Any], shape: tuple[int, ...] = ()) -> Array:
    """Return N numbers or arrays of a shape as one, shape (N, ...); NaN for each None."""
    none = np.full(shape, np.nan)
    stacked = np.array([none if one is None else one for one in values], np.float64)
    return stacked.reshape(-1, *shape)


def standard_deviations(covariance: Array) -> Array:
    """Return the roots of the diagonals of covariances (..., 3, 3), shape (..., 3)."""
    sigma: Array = np.sqrt(np.einsum("...ii->...i", covariance).clip(min=0.0))
    return sigma
