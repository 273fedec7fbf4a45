"""Digitising with a pointer: a landmark as the mean of its tip while it is held still."""

from collections import deque
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.stats import t as student

from compute.errors import InvalidParameter, NotStationary, TooFewPoses

Array = NDArray[np.float64]

_NOTHING: Final = np.zeros((3, 3))
_DRIFT_SIGNIFICANCE: Final = 1e-4
"""Significance level of a drift: one of 10,000 still captures shows one by chance."""


@dataclass(frozen=True)
class StationarySettings:
    """Criteria of a tip that is held still.

    Args:
        seconds: time for which it must be still [s].
        min_poses: smallest number of positions in this time.
        max_sigma_mm: largest standard deviation of a position in space (root of the trace of
            the scatter) [mm].
        max_drift_mm: largest drift from beginning to end of the capture [mm]; a drift within the
            noise counts as 0.
        max_gap_s: longest time without a position [s].
    """

    seconds: float = 0.5
    min_poses: int = 10
    max_sigma_mm: float = 0.5
    max_drift_mm: float = 0.3
    max_gap_s: float = 0.1

    def __post_init__(self) -> None:
        for name in ("seconds", "max_sigma_mm", "max_drift_mm", "max_gap_s"):
            if not getattr(self, name) > 0.0:
                raise InvalidParameter(f"{name} is {getattr(self, name)}; it must be above 0")
        if self.min_poses < 4:
            raise InvalidParameter(f"min_poses is {self.min_poses}; it must be at least 4")


@dataclass(frozen=True, eq=False)
class StationaryPoint:
    """Position of a tip that was held still.

    Args:
        position_mm: mean, shape (3,) [mm].
        covariance_mm2: covariance of the mean, shape (3, 3) [mm^2]: the scatter over the number of
            positions, plus the part that is common to all positions: the known common part, such
            as the tip's own, and what their covariances exceed the scatter by.
        sigma_mm: standard deviation of a position in space [mm].
        drift_mm: drift from beginning to end, by a straight line [mm].
        poses: number of positions.
        first_ns: time of the first [ns].
        last_ns: time of the last [ns].
    """

    position_mm: Array
    covariance_mm2: Array
    sigma_mm: float
    drift_mm: float
    poses: int
    first_ns: int
    last_ns: int


def average_stationary_tip(
    times_ns: NDArray[np.int64],
    positions_mm: Array,
    covariances_mm2: Array | None = None,
    settings: StationarySettings | None = None,
    shared_mm2: Array | None = None,
) -> StationaryPoint:
    """Return the mean of all given positions of a tip, if it was held still.

    Args:
        times_ns: ascending, shape (N,) [ns].
        positions_mm: positions in the landmark's frame, such as the reference tool's,
            shape (N, 3) [mm].
        covariances_mm2: shape (N, 3, 3) [mm^2]; None: unknown, the scatter is used.
        settings: criteria of a still tip.
        shared_mm2: part of these covariances that is common to all positions,
            shape (N, 3, 3) [mm^2]; None: none.

    Raises:
        TooFewPoses: there are too few, over too short a time, or with a gap.
        NotStationary: scatter or drift is too large.
    """
    criteria = settings or StationarySettings()
    times = (np.asarray(times_ns, np.int64) - times_ns[0]) * 1e-9 if len(times_ns) else np.empty(0)
    positions = np.asarray(positions_mm, dtype=np.float64)
    _check_times(times, criteria)
    count = len(positions)
    mean = positions.mean(axis=0)
    off = positions - mean
    scatter = off.T @ off / (count - 1)
    deviation = float(np.sqrt(np.trace(scatter)))
    if deviation > criteria.max_sigma_mm:
        raise NotStationary(
            f"the tip scattered by {deviation:.3g} mm over {times[-1]:.2f} s; it must be within "
            f"{criteria.max_sigma_mm:g} mm",
            sigma_mm=deviation,
            max_mm=criteria.max_sigma_mm,
        )
    drift, least = _drift(times, off)
    if least > criteria.max_drift_mm:
        raise NotStationary(
            f"the tip moved by {drift:.3g} mm in {times[-1]:.2f} s; it must be within "
            f"{criteria.max_drift_mm:g} mm",
            drift_mm=drift,
            max_mm=criteria.max_drift_mm,
        )
    covariance = scatter / count
    shared = np.zeros((3, 3)) if shared_mm2 is None else np.mean(shared_mm2, axis=0)
    if covariances_mm2 is not None:
        independent = np.mean(covariances_mm2, axis=0) - shared
        covariance = covariance + shared + positive_semidefinite_part(independent - scatter)
    return StationaryPoint(
        mean, covariance, deviation, drift, count, int(times_ns[0]), int(times_ns[-1])
    )


def _check_times(times: Array, criteria: StationarySettings) -> None:
    if len(times) < criteria.min_poses:
        raise TooFewPoses(
            f"{len(times)} positions of the tip; a capture needs at least {criteria.min_poses}",
            poses=len(times),
            needed=criteria.min_poses,
        )
    steps = np.diff(times)
    if (steps <= 0.0).any():
        raise InvalidParameter("the times of the tip's positions do not ascend")
    if times[-1] < criteria.seconds * (1.0 - 1e-9):
        raise TooFewPoses(
            f"the tip's positions span {times[-1]:.3g} s; "
            f"it must be held for {criteria.seconds:g} s",
            seconds=float(times[-1]),
            needed_s=criteria.seconds,
        )
    if steps.max() > criteria.max_gap_s:
        raise TooFewPoses(
            f"the tip was not seen for {steps.max():.3g} s; gaps must be at most "
            f"{criteria.max_gap_s:g} s",
            gap_s=float(steps.max()),
        )


def _drift(times: Array, off: Array) -> tuple[float, float]:
    """Return the movement along the fitted line, and the least that is not noise [mm]."""
    centred = times - times.mean()
    slope = centred @ off / (centred @ centred)
    residual = off - np.outer(centred, slope)
    count = len(times)
    noise = np.sqrt(np.maximum((residual**2).sum(axis=0), 0.0) / (count - 2) / (centred @ centred))
    # One bound for three axes (Bonferroni), both signs.
    bound = noise * student.isf(_DRIFT_SIGNIFICANCE / 6.0, count - 2)
    least = np.maximum(np.abs(slope) - bound, 0.0)
    return float(np.linalg.norm(slope) * times[-1]), float(np.linalg.norm(least) * times[-1])


def positive_semidefinite_part(matrix: Array) -> Array:
    """Return a symmetric matrix (n, n) without its negative eigenvalues."""
    values, axes = np.linalg.eigh(matrix)
    positive: Array = (axes * np.maximum(values, 0.0)) @ axes.T
    return positive


class StationaryCapture:
    """Collects positions of a tip until it was held still for long enough."""

    def __init__(self, settings: StationarySettings | None = None) -> None:
        """Begin a capture."""
        self._settings = settings or StationarySettings()
        self._samples: deque[tuple[int, Array, Array | None, Array]] = deque()
        self._error: NotStationary | TooFewPoses | None = None

    @property
    def error(self) -> NotStationary | TooFewPoses:
        """Why there is no point yet, as an exception for callers that stop waiting."""
        return self._error or TooFewPoses("no position of the tip yet")

    @property
    def reason(self) -> str:
        """Why there is no point yet."""
        return self.error.detail

    def add_sample(
        self,
        time_ns: int,
        position_mm: Array | None,
        covariance_mm2: Array | None = None,
        shared_mm2: Array | None = None,
    ) -> None:
        """Add a position, without the test whether the tip is still; ``take`` tests it.

        Args:
            time_ns: [ns]; a time that goes back restarts the capture.
            position_mm: shape (3,) [mm]; None: the tip is not visible.
            covariance_mm2: shape (3, 3) [mm^2]; None: unknown.
            shared_mm2: part of the covariance that is common to all positions, shape (3, 3) [mm^2];
                None: none.
        """
        samples = self._samples
        if samples and time_ns <= samples[-1][0]:
            samples.clear()
        if position_mm is None:
            self._error = TooFewPoses("the tip is not seen")
            return
        shared = _NOTHING if shared_mm2 is None else shared_mm2
        samples.append((time_ns, np.asarray(position_mm, np.float64), covariance_mm2, shared))
        # As short as allowed, so that earlier motion does not count.
        while len(samples) > 1 and (time_ns - samples[1][0]) * 1e-9 >= self._settings.seconds:
            samples.popleft()

    def take(self) -> StationaryPoint | None:
        """Return the point if the last ``seconds`` were still, and restart; None: they were not."""
        samples = self._samples
        times, positions, covariances, shared = zip(*samples, strict=True) if samples else ([],) * 4
        try:
            point = average_stationary_tip(
                np.array(times, np.int64),
                np.array(positions).reshape(-1, 3),
                None if any(one is None for one in covariances) else np.array(covariances),
                self._settings,
                np.array(shared) if samples else None,
            )
        except (NotStationary, TooFewPoses) as error:
            self._error = error
            return None
        samples.clear()
        self._error = None
        return point
