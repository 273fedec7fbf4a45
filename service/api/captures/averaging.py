"""Mean readings of a stationary marker; checks that it rested, and moved between targets."""

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from service.api.captures.schema import CapturedSensor, CapturedTarget
from service.problems.errors import MarkerNotMoved, NoObservation, TargetMoved

Array = NDArray[np.float64]

MIN_SENSORS: Final = 3
_FALSE_ALARM_PROBABILITY: Final = 1e-4
"""That a marker at rest is taken for moving, of all sensors together, or the other way round."""
_EXCESS_SIGMA_FACTOR: Final = 2.0
"""By so much may the peaks' own deviations be too small before it is movement."""
_FLOOR_PX: Final = 0.02
"""Spread that is never taken for movement: interpolation error of a dithering peak."""


@dataclass(frozen=True, eq=False)
class AveragedReading:
    """Readings of S sensors, each shape (S,); NaN where a sensor did not see the marker.

    Args:
        total_frames: that were averaged.
        frames: in which it was seen.
        mean_px: mean reading [px].
        spread_px: standard deviation of one reading [px].
        stated_px: root mean square of the peaks' own deviations [px].
        sigma_px: standard deviation of the mean [px]: of the larger of the two.
    """

    total_frames: int
    frames: NDArray[np.intp]
    mean_px: Array
    spread_px: Array
    stated_px: Array
    sigma_px: Array


def average(
    position_px: Array, sigma_px: Array, sensors: Sequence[str], seen_share: float, target: str
) -> AveragedReading:
    """Average the readings of a marker held still.

    Args:
        position_px: shape (F, S) [px]; NaN where a sensor saw no clear peak in a frame.
        sigma_px: the peaks' own deviations, shape (F, S) [px]; NaN where not known.
        sensors: their names.
        seen_share: of the frames in which a sensor must have seen it; others count as not seeing.
        target: the target's name, for messages.

    Raises:
        NoObservation: fewer than three sensors saw it.
        TargetMoved: a sensor's readings spread, or drift from the first half of the frames to
            the second, by more than their noise explains.
    """
    frames = len(position_px)
    seen = np.isfinite(position_px)
    count = seen.sum(axis=0)
    enough = count >= max(3, int(np.ceil(seen_share * frames)))
    if enough.sum() < MIN_SENSORS:
        listed = ", ".join(
            f"{name} {number}" for name, number in zip(sensors, count.tolist(), strict=True)
        )
        raise NoObservation(
            f'of {frames} frames of target "{target}" the sensors saw one clear peak in: {listed}; '
            f"at least {MIN_SENSORS} sensors must see it in {seen_share:.0%} of them: one marker "
            "lit, in view, no reflections",
            target=target,
            frames=frames,
        )
    known = np.where(seen & enough, position_px, np.nan)
    mean, spread, stated = (np.full(len(sensors), np.nan) for _ in range(3))
    for column in np.flatnonzero(enough).tolist():
        values = known[seen[:, column], column]
        own = sigma_px[seen[:, column], column]
        mean[column], spread[column] = values.mean(), values.std(ddof=1)
        if np.isfinite(own).any():
            stated[column] = np.sqrt(np.nanmean(own**2))
        _check_rest(values, stated[column], sensors[column], target, int(enough.sum()))
    larger = np.fmax(np.fmax(spread, stated), 1e-6)
    return AveragedReading(
        frames, count, mean, spread, stated, larger / np.sqrt(np.maximum(count, 1))
    )


def to_captured(
    target: str, found: AveragedReading, sensors: Sequence[str], captured_at: datetime
) -> CapturedTarget:
    """Return what was read of a target as a session keeps it.

    Args:
        target: its name.
        found: its mean readings.
        sensors: names of the sensors.
        captured_at: when they were captured.
    """
    return CapturedTarget(
        target=target,
        frames=found.total_frames,
        sensors=[
            CapturedSensor(
                sensor=name,
                frames=int(found.frames[column]),
                mean_px=float(found.mean_px[column]),
                spread_px=float(found.spread_px[column]),
                stated_px=(
                    float(found.stated_px[column]) if np.isfinite(found.stated_px[column]) else None
                ),
                sigma_px=float(found.sigma_px[column]),
            )
            for column, name in enumerate(sensors)
            if np.isfinite(found.mean_px[column])
        ],
        captured_at=captured_at,
    )


def _check_rest(values: Array, stated_px: float, sensor: str, target: str, sensors: int) -> None:
    """Check that readings, in the order of the frames, are of a stationary marker."""
    chance = _FALSE_ALARM_PROBABILITY / (2 * sensors)
    count = len(values)
    spread = float(values.std(ddof=1))
    if np.isfinite(stated_px):
        # Stated deviations are honest within a factor; movement is what lies beyond it.
        limit = max(_EXCESS_SIGMA_FACTOR * stated_px, _FLOOR_PX) * np.sqrt(
            float(chi2.isf(chance, count - 1)) / (count - 1)
        )
        if spread > limit:
            raise TargetMoved(
                f'target "{target}": the readings of sensor {sensor} spread by {spread:.3g} px; '
                f"their noise explains {limit:.3g} px at most: hold it still and capture it again",
                target=target,
                sensor=sensor,
                spread_px=spread,
                limit_px=limit,
            )
    half = count // 2
    first, second = values[:half], values[half:]
    if half < 3:
        return
    within = np.sqrt((first.var(ddof=1) / len(first)) + (second.var(ddof=1) / len(second)))
    drift = float(abs(second.mean() - first.mean()))
    limit = max(float(np.sqrt(chi2.isf(chance, 1))) * 1.5 * float(within), _FLOOR_PX)
    if drift > limit:
        raise TargetMoved(
            f'target "{target}": the readings of sensor {sensor} drift by {drift:.3g} px while it '
            f"is captured; their noise explains {limit:.3g} px at most: wait until it rests and "
            "capture it again",
            target=target,
            sensor=sensor,
            drift_px=drift,
            limit_px=limit,
        )


MIN_POINT_DISTANCE_MM: Final = 0.1
"""Targets nearer than this may be read the same."""
_SETTLING_PX: Final = 0.01
"""Deviation of a mean that noise does not show: how a marker settles."""


def check_marker_moved(found: CapturedTarget, others: Sequence[CapturedTarget]) -> None:
    """Check that a target's readings are not those of another.

    Sensors that see only one of the two say nothing; at least three must see both.

    Args:
        found: what was read of the target.
        others: what was read of targets elsewhere, in order.

    Raises:
        MarkerNotMoved: in all sensors that saw both, another was read the same within the noise.
    """
    now = {one.sensor: one for one in found.sensors}
    for other in reversed(others):
        if other.target == found.target:
            continue
        pairs = [(now[one.sensor], one) for one in other.sensors if one.sensor in now]
        if len(pairs) < MIN_SENSORS:
            continue
        squares = [
            (one.mean_px - before.mean_px) ** 2
            / (one.sigma_px**2 + before.sigma_px**2 + _SETTLING_PX**2)
            for one, before in pairs
        ]
        if sum(squares) <= float(chi2.isf(_FALSE_ALARM_PROBABILITY, len(pairs))):
            largest = max(abs(one.mean_px - before.mean_px) for one, before in pairs)
            raise MarkerNotMoved(
                f'target "{found.target}" reads as target "{other.target}" does, within '
                f"{largest:.2g} px in all {len(pairs)} sensors that see both: is the marker still "
                f'at "{other.target}"? Move it and capture again; of strobed markers name each '
                "target's own",
                target=found.target,
                other=other.target,
                largest_px=largest,
            )
