"""Errors of two tracks along a sensor: identity, spikes, RMS."""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

APART: Final = 0.2
"""Where the markers are nearer than this share of their greatest distance, whose a track is does
not show."""
SPIKE: Final = 0.5
"""A velocity off from both markers' by more than this share of their greatest is a spike."""


@dataclass(frozen=True)
class SensorFigures:
    """How two tracks follow two markers.

    Args:
        crossings: of the markers, counted for each track.
        exchanged: how often a track went over to the other marker.
        right: share of the frames in which a track is on its own marker, of those in which the
            markers are apart.
        spikes: frames in which a track's velocity is neither marker's.
        position_rms: over the frames in which a track is on its own marker, in the unit of the
            positions.
        velocity_rms, acceleration_rms: likewise, spikes included.
    """

    crossings: int
    exchanged: int
    right: float
    spikes: int
    position_rms: float
    velocity_rms: float
    acceleration_rms: float


def sensor_figures(
    position: Array,
    moving: tuple[Array, Array],
    truth: Array,
    truly_moving: tuple[Array, Array],
) -> SensorFigures:
    """Return the figures of two tracks, the k-th of which began at the k-th marker.

    Args:
        position: of the tracks, shape (N, 2), NaN where there is none.
        moving: their velocity and acceleration, (N, 2) each; NaN: none.
        truth: of the markers, shape (N, 2).
        truly_moving: their velocity and acceleration, (N, 2) each.
    """
    distance = np.abs(truth[:, 1] - truth[:, 0])
    apart = np.asarray(distance > APART * distance.max())
    side = np.sign(truth[:, 1] - truth[:, 0])[apart]
    off = np.abs(position[:, :, None] - truth[:, None, :])
    there = np.asarray(~np.isnan(position).any(axis=1))
    owner = np.where(there[:, None], np.nan_to_num(off, nan=0.0).argmin(axis=2), -1)
    judged = owner[apart & there]
    own = (owner == np.arange(2)) | ~apart[:, None]
    # Between two frames with the markers apart the track is its own if it was and is.
    own &= _held(owner == np.arange(2), apart)
    velocity_off = np.abs(moving[0][:, :, None] - truly_moving[0][:, None, :]).min(axis=2)
    greatest = float(np.nanmax(np.abs(truly_moving[0])))

    def rms(found: Array, true: Array) -> float:
        squares = ((found - true) ** 2)[own & there[:, None]]
        return float(np.sqrt(np.nanmean(squares))) if np.isfinite(squares).any() else float("nan")

    return SensorFigures(
        2 * int((np.diff(side) != 0.0).sum()),
        int((np.diff(judged, axis=0) != 0).sum()),
        float((judged == np.arange(2)).mean()),
        int((velocity_off > SPIKE * greatest).sum()),
        rms(position, truth),
        rms(moving[0], truly_moving[0]),
        rms(moving[1], truly_moving[1]),
    )


def together(figures: list[SensorFigures]) -> SensorFigures:
    """Return the figures of several sensors: sums, means, and root mean squares."""

    def mean_square(name: str) -> float:
        values = np.array([getattr(one, name) for one in figures])
        return float(np.sqrt(np.nanmean(values**2))) if np.isfinite(values).any() else float("nan")

    return SensorFigures(
        sum(one.crossings for one in figures),
        sum(one.exchanged for one in figures),
        float(np.mean([one.right for one in figures])),
        sum(one.spikes for one in figures),
        mean_square("position_rms"),
        mean_square("velocity_rms"),
        mean_square("acceleration_rms"),
    )


def _held(right: NDArray[np.bool_], apart: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return, (N, 2), whether the last and the next frame with the markers apart are right."""
    frames = np.arange(len(apart))
    last = np.maximum.accumulate(np.where(apart, frames, -1))
    following = np.minimum.accumulate(np.where(apart, frames, len(apart))[::-1])[::-1]
    before = np.where((last >= 0)[:, None], right[np.maximum(last, 0)], True)
    after = np.where(
        (following < len(apart))[:, None], right[np.minimum(following, len(apart) - 1)], True
    )
    return np.asarray(before & after)
