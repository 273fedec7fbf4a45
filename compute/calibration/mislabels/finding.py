"""One label error in control data, and how sure it is."""

from dataclasses import dataclass
from typing import Literal

LabelErrorKind = Literal["wrong", "exchanged", "missing"]


@dataclass(frozen=True)
class LabelFinding:
    """One label error.

    Args:
        kind: "wrong": the reading is none of this point's. "exchanged": readings carry each
            other's labels. "missing": the reading belongs to another point, which has none.
        sensor: the sensor's name; None: all sensors, the points themselves carry each other's
            labels.
        points: counted from 1. "wrong": the point. "exchanged": the reading labelled with each
            of these belongs to the next, the last one's to the first. "missing": the label that
            the reading carries, and the point that it belongs to.
        probability: that this is so, among all explanations looked at, from 0 to 1.
        residual_px: by how much the readings labelled ``points`` miss what the sensor, calibrated
            without the error, reads there [px]; for all sensors, by that which misses it most;
            NaN where there is no reading is given as None.
        normalised_residual: the same over the standard deviation of that difference, noise and the
            calibration's uncertainty.
    """

    kind: LabelErrorKind
    sensor: str | None
    points: tuple[int, ...]
    probability: float
    residual_px: tuple[float | None, ...]
    normalised_residual: tuple[float | None, ...]
