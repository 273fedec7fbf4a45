"""LabelFinding: one label error in control data; its repair or exclusion."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from compute.camera.observation_checks import Sensor
from compute.errors import InvalidParameter

Array = NDArray[np.float64]
LabelErrorKind = Literal["outlier", "exchanged", "wrong-label"]


@dataclass(frozen=True)
class LabelFinding:
    """One label error, or one outlier.

    Args:
        kind: "exchanged": readings carry each other's labels. "wrong-label": the reading belongs
            to another point, which has none. "outlier": the reading's error is in the tail of the
            noise, five standard deviations or more, or gross; no label explains it.
        sensor: the sensor's name; None: all sensors, the points themselves carry each other's
            labels.
        points: counted from 1. "outlier": the point. "exchanged": the reading labelled with each
            of these belongs to the next, the last one's to the first. "wrong-label": the label
            that the reading carries, and the point that it belongs to.
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


def exclude(
    findings: Sequence[LabelFinding],
    sensors: Sequence[Sensor],
    readings_px: Array,
    sigma_px: Array | None = None,
) -> tuple[Array, Array | None]:
    """Return readings without those that a finding is about (NaN).

    Args:
        findings: of ``find_label_errors``, in its order, or some of them.
        sensors: the device's sensors in order.
        readings_px: readings, shape (N, S) [px]; NaN where not seen.
        sigma_px: their standard deviations, shape (N, S) [px], or None; returned unchanged.

    Raises:
        InvalidParameter: a finding names an unknown sensor or point.
    """
    readings = np.array(readings_px, dtype=np.float64)
    label = list(range(len(readings)))  # where what is now at a point came from
    for finding in findings:
        columns, points = _where(finding, sensors, readings)
        if finding.sensor is None:
            readings[points] = np.nan
            for first, second in pairwise(points):
                label[first], label[second] = label[second], label[first]
        else:
            readings[[label[point] for point in points], columns] = np.nan
    return readings, None if sigma_px is None else np.array(sigma_px, dtype=np.float64)


def repair(
    findings: Sequence[LabelFinding],
    sensors: Sequence[Sensor],
    readings_px: Array,
    sigma_px: Array | None = None,
) -> tuple[Array, Array | None]:
    """Return readings assigned to their own points; outliers are NaN.

    Args:
        findings: of ``find_label_errors``, those of all sensors first: findings of single sensors
            refer to the labels that these have repaired.
        sensors: the device's sensors in order.
        readings_px: readings, shape (N, S) [px]; NaN where not seen.
        sigma_px: their standard deviations, shape (N, S) [px], or None.

    Returns:
        Readings and standard deviations, shape (N, S) [px].

    Raises:
        InvalidParameter: a finding names an unknown sensor or point.
    """
    readings = np.array(readings_px, dtype=np.float64)
    sigma = None if sigma_px is None else np.array(sigma_px, dtype=np.float64)
    for finding in findings:
        columns, points = _where(finding, sensors, readings)
        if finding.kind == "outlier":
            readings[np.ix_(points, columns)] = np.nan
            continue
        there, here = [*points[1:], points[0]], points
        for array in (readings, sigma):
            if array is not None:
                array[np.ix_(there, columns)] = array[np.ix_(here, columns)]
    return readings, sigma


def _where(
    finding: LabelFinding, sensors: Sequence[Sensor], readings: Array
) -> tuple[list[int], list[int]]:
    names = [sensor.name for sensor in sensors]
    if finding.sensor is not None and finding.sensor not in names:
        raise InvalidParameter(
            f'a label finding names sensor "{finding.sensor}"; the sensors are {", ".join(names)}',
            sensor=finding.sensor,
        )
    outside = [point for point in finding.points if not 1 <= point <= len(readings)]
    if outside:
        raise InvalidParameter(
            f"a label finding names point {outside[0]}; there are points 1 to {len(readings)}"
        )
    columns = range(len(names)) if finding.sensor is None else [names.index(finding.sensor)]
    return list(columns), [point - 1 for point in finding.points]


CORRECTIONS: Final = {"exclude": exclude, "repair": repair}
"""The corrections of the label policies; the others correct nothing."""
