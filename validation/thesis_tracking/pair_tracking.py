"""Tracking of two targets along one sensor over a recording, section 6.1.3."""

from dataclasses import dataclass
from math import isfinite
from typing import get_args

import numpy as np
from numpy.typing import NDArray

from compute.errors import InvalidParameter
from validation.thesis_tracking.pair_tracker import Decision, PairTracker
from validation.thesis_tracking.quadratic_window import THESIS_POINTS, QuadraticWindow

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class PairTracks:
    """Two tracks along one sensor: Track 1, which starts in Subset 1, and Track 2.

    Args:
        position_px: shape (N, 2).
        predicted_px: by the quadratic window, from the points before; NaN at the first, (N, 2).
        subset: the subset that each point is from, 0 or 1, int8, shape (N, 2).
        switched: where the track went over to the other subset, bool, shape (N, 2).
        created: where the point was made up (gap filling), bool, shape (N, 2).
    """

    position_px: Array
    predicted_px: Array
    subset: NDArray[np.int8]
    switched: NDArray[np.bool_]
    created: NDArray[np.bool_]


@dataclass(frozen=True)
class PairTracking:
    """The block diagram of Figure 6.4, as far as the text tells it; the figure is lost.

    Gaps in both subsets are filled first. Each target is then followed by itself: Target 1 from
    Subset 1, Target 2 from Subset 2. In each scan the current subset's point is looked at, and
    the velocity to it from the track's last point [6.2] is compared with the track's velocity
    between its last two points. At an end of the motion the sign changes and the magnitude
    hardly; where the targets cross, the subset's curve turns back, and the sign changes together
    with the magnitude.

    - "velocity", as the text has it: where the sign changes and the velocity by more than the
      limit delta, the other target has taken over the subset, and the track goes on in the
      other one.
    - "prediction": the track takes the subset whose point is nearer to the position that the
      quadratic window predicts. The text calculates that position and then decides without it.

    Where the crossing lies midway between two scans, the subset's velocity falls to zero in one
    scan and to the opposite in the next: the sign changes a scan too late, and the track takes
    one wrong point, or does not go over at all. These are the spikes of Figure 6.6.

    Args:
        velocity_limit_px_s: delta, the largest change that is still one target's [px/s], above
            zero. The text gives no figure; it has to lie between the change that the motion
            itself makes from scan to scan and the targets' velocity at a crossing.
        interval_s: the sampling period [s], above zero; scans are taken as equally far apart.
        points: n of the quadratic window.
        decision: how the subset is chosen.

    Raises:
        InvalidParameter: a value outside its range.
    """

    velocity_limit_px_s: float
    interval_s: float
    points: int = THESIS_POINTS
    decision: Decision = "velocity"

    def __post_init__(self) -> None:
        for name in ("velocity_limit_px_s", "interval_s"):
            value = getattr(self, name)
            if not (isfinite(value) and value > 0.0):
                raise InvalidParameter(
                    f"{name} is {value}; it must be above zero and finite", **{name: value}
                )
        if self.decision not in get_args(Decision):
            raise InvalidParameter(
                f"decision is {self.decision!r}; it must be one of {get_args(Decision)}",
                decision=self.decision,
            )
        QuadraticWindow(self.points)

    def run(self, subsets_px: Array) -> PairTracks:
        """Follow both targets.

        Args:
            subsets_px: Subset 1 and Subset 2 of N successive scans, shape (N, 2) [px], NaN where
                a point is missing: ``order_by_detection``. Both must have a point in the first
                scan.

        Raises:
            InvalidParameter: subsets of another shape, or without a point in the first scan.
        """
        values = np.asarray(subsets_px, dtype=np.float64)
        if values.ndim != 2 or values.shape[1] != 2 or not len(values):
            raise InvalidParameter(
                f"subsets have the shape {values.shape}; they must be (scans, 2), and not empty",
                shape=values.shape,
            )
        if np.isnan(values[0]).any():
            raise InvalidParameter(
                f"the first scan has the points {values[0].tolist()}; both targets must be seen in "
                "it: leave out the scans before"
            )
        follower = PairTracker(
            values[0], self.velocity_limit_px_s, QuadraticWindow(self.points), self.decision
        )
        shape = values.shape
        position, predicted = values.copy(), np.full(shape, np.nan)
        subset, created = np.tile(np.arange(2, dtype=np.int8), (shape[0], 1)), np.zeros(shape, bool)
        for scan in range(1, len(values)):
            for track, now in enumerate(follower.step(values[scan], self.interval_s)):
                position[scan, track], predicted[scan, track] = now.position_px, now.predicted_px
                subset[scan, track], created[scan, track] = now.subset, now.created
        switched = np.zeros(shape, dtype=np.bool_)
        switched[1:] = subset[1:] != subset[:-1]
        return PairTracks(position, predicted, subset, switched, created)
