"""LabelFinding: one label error in control data, with its probability."""

from dataclasses import dataclass
from typing import Literal

LabelErrorKind = Literal["wrong", "exchanged", "missing"]


@dataclass(frozen=True)
class LabelFinding:
    """One label error.

    Args:
        kind: "wrong": the reading belongs to no point. "exchanged": readings carry each other's
            labels. "missing": the reading belongs to another point, which has none.
        sensor: the sensor's name; None: all sensors, the points themselves carry each other's
            labels.
        points: counted from 1. "wrong": the point. "exchanged": the reading labelled with each
            of these belongs to the next, the last one's to the first. "missing": the label that
            the reading carries, and the point that it belongs to.
        probability: posterior probability, among all hypotheses examined, 0 to 1.
        residual_px: residuals of the readings labelled ``points`` from the sensor calibrated
            without the error [px]; for all sensors, from the one with the largest; None without a
            reading.
        normalised_residual: the same over its standard deviation, from noise and calibration.
    """

    kind: LabelErrorKind
    sensor: str | None
    points: tuple[int, ...]
    probability: float
    residual_px: tuple[float | None, ...]
    normalised_residual: tuple[float | None, ...]
