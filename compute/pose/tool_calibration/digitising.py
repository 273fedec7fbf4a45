"""Digitising pointer: a landmark as the mean of its tip while it is held still."""

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
"""A drift is one when chance makes as much of it in one still capture of 10 000."""


@dataclass(frozen=True)
class StationarySettings:
    """When a tip counts as held still.

    Args:
        seconds: how long it has to be still [s].
        min_poses: fewest positions in this time.
        max_sigma_mm: largest standard deviation of a position in space (root of the trace of
            the scatter) [mm].
        max_drift_mm: largest movement from the begin to the end of the capture that may be real
            [mm]; one that noise explains is none.
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
    """A point that was held.

    Args:
        position_mm: the mean, shape (3,) [mm].
        covariance_mm2: of the mean, shape (3, 3) [mm^2]: the scatter over the number of
            positions, and what is common to all of them and no mean makes smaller: what is known
            to be, such as the tip's own, and what their other covariances say beyond the scatter.
        sigma_mm: standard deviation of a position in space [mm].
        drift_mm: movement from begin to end, by a straight line [mm].
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
    """Return the mean of a tip's positions, all of them, if it was held still.

    Args:
        times_ns: ascending, shape (N,) [ns].
        positions_mm: in the frame that the landmark is wanted in, such as the reference tool's,
            shape (N, 3) [mm].
        covariances_mm2: shape (N, 3, 3) [mm^2]; None: the scatter is all that is known.
        settings: what counts as still.
        shared_mm2: what of these covariances is known to be common to all positions,
            shape (N, 3, 3) [mm^2]; None: nothing.

    Raises:
        TooFewPoses: there are too few, over too short a time, or with a gap.
        NotStationary: they scatter or drift more than allowed.
    """
    wanted = settings or StationarySettings()
    times = (np.asarray(times_ns, np.int64) - times_ns[0]) * 1e-9 if len(times_ns) else np.empty(0)
    positions = np.asarray(positions_mm, dtype=np.float64)
    _check_times(times, wanted)
    count = len(positions)
    mean = positions.mean(axis=0)
    off = positions - mean
    scatter = off.T @ off / (count - 1)
    deviation = float(np.sqrt(np.trace(scatter)))
    if deviation > wanted.max_sigma_mm:
        raise NotStationary(
            f"the tip scattered by {deviation:.3g} mm over {times[-1]:.2f} s; it must be within "
            f"{wanted.max_sigma_mm:g} mm",
            sigma_mm=deviation,
            max_mm=wanted.max_sigma_mm,
        )
    drift, least = _drift(times, off)
    if least > wanted.max_drift_mm:
        raise NotStationary(
            f"the tip moved by {drift:.3g} mm in {times[-1]:.2f} s; it must be within "
            f"{wanted.max_drift_mm:g} mm",
            drift_mm=drift,
            max_mm=wanted.max_drift_mm,
        )
    covariance = scatter / count
    shared = np.zeros((3, 3)) if shared_mm2 is None else np.mean(shared_mm2, axis=0)
    if covariances_mm2 is not None:
        own = np.mean(covariances_mm2, axis=0) - shared
        covariance = covariance + shared + _beyond(own, scatter)
    return StationaryPoint(
        mean, covariance, deviation, drift, count, int(times_ns[0]), int(times_ns[-1])
    )


def _check_times(times: Array, wanted: StationarySettings) -> None:
    if len(times) < wanted.min_poses:
        raise TooFewPoses(
            f"{len(times)} positions of the tip; a capture needs at least {wanted.min_poses}",
            poses=len(times),
            needed=wanted.min_poses,
        )
    steps = np.diff(times)
    if (steps <= 0.0).any():
        raise InvalidParameter("the times of the tip's positions do not ascend")
    if times[-1] < wanted.seconds * (1.0 - 1e-9):
        raise TooFewPoses(
            f"the tip's positions span {times[-1]:.3g} s; it must be held for {wanted.seconds:g} s",
            seconds=float(times[-1]),
            needed_s=wanted.seconds,
        )
    if steps.max() > wanted.max_gap_s:
        raise TooFewPoses(
            f"the tip was not seen for {steps.max():.3g} s; gaps must be at most "
            f"{wanted.max_gap_s:g} s",
            gap_s=float(steps.max()),
        )


def _drift(times: Array, off: Array) -> tuple[float, float]:
    """Return the movement along the fitted line, and the least that is not noise [mm]."""
    centred = times - times.mean()
    slope = centred @ off / (centred @ centred)
    left = off - np.outer(centred, slope)
    count = len(times)
    noise = np.sqrt(np.maximum((left**2).sum(axis=0), 0.0) / (count - 2) / (centred @ centred))
    # One bound for three axes (Bonferroni), both signs.
    bound = noise * student.isf(_DRIFT_SIGNIFICANCE / 6.0, count - 2)
    least = np.maximum(np.abs(slope) - bound, 0.0)
    return float(np.linalg.norm(slope) * times[-1]), float(np.linalg.norm(least) * times[-1])


def _beyond(stated: Array, scatter: Array) -> Array:
    """Return what a stated covariance has beyond the scatter, without negative directions."""
    values, axes = np.linalg.eigh(stated - scatter)
    found: Array = (axes * np.maximum(values, 0.0)) @ axes.T
    return found


class StationaryCapture:
    """Takes a tip's positions as they come, and tells when it was held still long enough."""

    def __init__(self, settings: StationarySettings | None = None) -> None:
        """Begin a capture."""
        self._settings = settings or StationarySettings()
        self._held: deque[tuple[int, Array, Array | None, Array]] = deque()
        self._error: NotStationary | TooFewPoses | None = None

    @property
    def error(self) -> NotStationary | TooFewPoses:
        """What there is no point yet for, to be raised by who waits no longer."""
        return self._error or TooFewPoses("no position of the tip yet")

    @property
    def reason(self) -> str:
        """Why there is no point yet."""
        return self.error.detail

    def add(
        self, time_ns: int, position_mm: Array | None, covariance_mm2: Array | None = None
    ) -> StationaryPoint | None:
        """Return the point once the last ``seconds`` were still; begin anew after it.

        Args:
            time_ns: [ns]; one that goes back begins anew.
            position_mm: shape (3,) [mm]; None: the tip is not known now.
            covariance_mm2: shape (3, 3) [mm^2].
        """
        self.add_sample(time_ns, position_mm, covariance_mm2)
        return None if position_mm is None else self.take()

    def add_sample(
        self,
        time_ns: int,
        position_mm: Array | None,
        covariance_mm2: Array | None = None,
        shared_mm2: Array | None = None,
    ) -> None:
        """Add a position without looking whether the tip is still: quick; see ``add``.

        ``shared_mm2`` is what of its covariance is common to all positions.
        """
        held, wanted = self._held, self._settings
        if held and time_ns <= held[-1][0]:
            held.clear()
        if position_mm is None:
            self._error = TooFewPoses("the tip is not seen")
            return
        shared = _NOTHING if shared_mm2 is None else shared_mm2
        held.append((time_ns, np.asarray(position_mm, np.float64), covariance_mm2, shared))
        # As short as it may be, lest the movement before it counts.
        while len(held) > 1 and (time_ns - held[1][0]) * 1e-9 >= wanted.seconds:
            held.popleft()

    def take(self) -> StationaryPoint | None:
        """Return the point if the last ``seconds`` that were put in were still, and begin anew."""
        held = self._held
        known = [one for _, _, one, _ in held if one is not None]
        try:
            found = average_stationary_tip(
                np.array([one for one, _, _, _ in held], np.int64),
                np.array([one for _, one, _, _ in held]).reshape(-1, 3),
                np.array(known) if len(known) == len(held) else None,
                self._settings,
                np.array([one for _, _, _, one in held]) if held else None,
            )
        except (NotStationary, TooFewPoses) as error:
            self._error = error
            return None
        held.clear()
        self._error = None
        return found
