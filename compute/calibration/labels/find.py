"""Find label errors in control data: which readings carry a label that is not theirs."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from math import log, pi
from statistics import median
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2 as chi2_distribution

from compute.calibration.checks import check_observations
from compute.calibration.labels.common import DeviceLabels, search_device
from compute.calibration.labels.evidence import KNOWN, ScalePrior
from compute.calibration.labels.finding import LabelErrorKind, LabelFinding
from compute.calibration.labels.hypothesis import Hypothesis
from compute.calibration.labels.lens import with_lens
from compute.calibration.labels.report import LabelReport
from compute.calibration.labels.sensor_search import (
    SensorLabels,
    SensorReadings,
    contradicted,
    search_labels,
)
from compute.camera.model import SensorGeometry

Array = NDArray[np.float64]

UNKNOWN: Final = ScalePrior(1.0, 0.3)
"""Deviations in pixels of which nothing is known: a pixel's quantisation, for what it is worth."""
UNKNOWN_FACTOR: Final = ScalePrior(1.0, 3.0)
"""Stated deviations that are not believed."""
ALIKE: Final = 6.0
"""Readings' worth of what the other sensors of a device say about one's deviations."""
DISBELIEVED: Final = log(1e-4)
"""Chance, before looking, that stated deviations are wrong by a common factor, or that a lens has
a distortion that does not contradict them everywhere."""
SUSPICIOUS: Final = 1e-4
"""Chance of squares so large, under the best explanation, that this is looked into."""


def find_label_errors(
    points_mm: Array,
    readings_px: Array,
    sensors: Sequence[SensorGeometry],
    sigma_px: Array | None = None,
    progress: Callable[[float, str], None] | None = None,
) -> LabelReport:
    """Find wrong, missing and exchanged labels; nothing is changed.

    Sensor by sensor, explanations (sets of wrong readings and of labels in each other's places)
    are compared by their posterior probability under a camera of seven parameters: normal
    readings where they are right, any place on the sensor where they are wrong. The search
    starts from least trimmed squares, runs in the linearised camera, where leaving out or
    exchanging readings changes the squares in closed form, and ends with fits of the camera
    itself. An exchange that all sensors together make likelier is one of the points.

    What cannot be seen is not found: an exchange of readings closer than some of their deviations,
    and a wrong reading of a point that the others hardly predict.

    Args:
        points_mm: control points, shape (N, 3).
        readings_px: readings, shape (N, S) [px]; NaN where a sensor did not see the point.
        sensors: the device's sensors in order.
        sigma_px: standard deviations of the readings, shape (N, S) [px]. None: one for each
            sensor, not known but alike. Where given ones are contradicted by most of the
            readings, a lens with distortion is thought of (two readings a parameter at least), and
            if that does not do, a common factor of the deviations.
        progress: told the share done and what is done; what it raises passes through.

    Raises:
        TooFewPoints, DegeneratePoints, NonFiniteValue, DuplicatePoint, ReadingOutsideSensor,
        InvalidParameter: the observations are not fit for a calibration.
    """
    points = np.asarray(points_mm, dtype=np.float64)
    readings = np.asarray(readings_px, dtype=np.float64)
    given = None if sigma_px is None else np.asarray(sigma_px, dtype=np.float64)
    check_observations(points, readings, sensors, given)
    sigma = np.ones(readings.shape) if given is None else np.where(np.isfinite(readings), given, 1)
    data = [
        SensorReadings(
            points,
            readings[:, column],
            sigma[:, column],
            sensor,
            UNKNOWN if given is None else KNOWN,
        )
        for column, sensor in enumerate(sensors)
    ]
    names = [sensor.name for sensor in sensors]

    found: list[SensorLabels] = []
    for column, one in enumerate(data):
        if progress is not None:
            progress(column / len(data), f"labels of {names[column]}")
        data[column], labels = _searched(one)
        found.append(labels)
    if given is None:
        chosen = list(zip(data, found, strict=True))
        usual = ScalePrior(ALIKE, median(labels.factor for _, labels in chosen))
        data = [replace(one, scale=usual) for one, _ in chosen]
        found = [search_labels(one) for one in data]
    return _report(search_device(data, found), readings, names)


def _searched(data: SensorReadings) -> tuple[SensorReadings, SensorLabels]:
    """Search one sensor's labels with the camera that explains its readings best.

    A camera without distortion where that leaves nothing to explain. Otherwise one with a lens
    is thought of, and where neither agrees with the stated deviations, a common factor of these:
    where a distortion is many deviations no number of wrong readings is a good explanation.
    """
    stated = data.scale is KNOWN
    misfit = stated and contradicted(data)
    plain: tuple[SensorReadings, SensorLabels] | None = None
    if not misfit:
        plain = data, search_labels(data)
        if stated and not _doubtful(*plain):
            return plain
    bent = _bent(data)
    if plain is None:
        if bent is not None and not contradicted(bent[0]):
            return bent
        free = replace(data if bent is None else bent[0], scale=UNKNOWN_FACTOR)
        return free, search_labels(free)
    ranked = [(_schwarz(*plain), plain)]
    if bent is not None:
        ranked.append((_schwarz(*bent) + DISBELIEVED, bent))
    if stated:
        free = replace(data, scale=UNKNOWN_FACTOR)
        labels = search_labels(free)
        ranked.append((_schwarz(free, labels) + DISBELIEVED, (free, labels)))
    return max(ranked, key=lambda entry: entry[0])[1]


def _doubtful(data: SensorReadings, labels: SensorLabels) -> bool:
    """Return whether the best explanation has errors, or squares too large."""
    best = labels.best
    limit = chi2_distribution.isf(SUSPICIOUS, max(best.kept - data.camera.width, 1))
    return best.hypothesis.size > 0 or bool(best.chi2 > limit)


def _bent(data: SensorReadings) -> tuple[SensorReadings, SensorLabels] | None:
    """Search with a lens; once more with the lens of the mended readings."""
    bent = with_lens(data)
    if bent is None:
        return None
    if data.scale is KNOWN and contradicted(bent):
        bent = replace(bent, scale=UNKNOWN_FACTOR)
    labels = search_labels(bent)
    if labels.best.hypothesis.size > 0:
        again = with_lens(data, labels.best.hypothesis)
        if again is not None:
            again = replace(again, scale=bent.scale)
            return again, search_labels(again)
    return bent, labels


def _schwarz(data: SensorReadings, labels: SensorLabels) -> float:
    """Return the best explanation's log posterior, fit to compare cameras of other forms.

    Its parameters are as likely beforehand as one reading makes them (Schwarz's criterion,
    doi:10.1214/aos/1176344136), instead of evenly.
    """
    best, width = labels.best, data.camera.width
    sign, log_determinant = np.linalg.slogdet(np.linalg.inv(_covariance(data, labels)))
    return float(
        best.log_posterior + 0.5 * log_determinant - 0.5 * width * log(2.0 * pi * best.kept)
        if sign > 0.0
        else -np.inf
    )


def _covariance(data: SensorReadings, labels: SensorLabels) -> Array:
    """Return the covariance of the camera's parameters under the best explanation."""
    _, slopes = data.camera.linearised(labels.best.theta[None])
    mended, sigma = labels.best.hypothesis.mended(data.readings_px, data.sigma_px)
    kept = np.isfinite(mended)
    weighted = slopes[0, kept] / sigma[kept, None]
    return np.asarray(np.linalg.inv(weighted.T @ weighted))


def _report(found: DeviceLabels, readings_px: Array, names: Sequence[str]) -> LabelReport:
    findings: list[LabelFinding] = []
    for exchange in found.common:
        misses = [
            _missed(labels, data, readings_px[:, column], exchange.pair)
            for column, (data, labels) in enumerate(zip(found.readings, found.sensors, strict=True))
        ]
        most = max(misses, key=lambda miss: max(abs(s or 0.0) for s in miss.in_sigma))
        findings.append(_finding("exchanged", None, exchange.pair, exchange.probability, most))
    for name, data, labels in zip(names, found.readings, found.sensors, strict=True):
        for kind, points, error in _errors(labels.best.hypothesis):
            miss = _missed(labels, data, data.readings_px, points)
            findings.append(_finding(kind, name, points, labels.probability(error), miss))
    sigma = tuple(
        float(np.sqrt((data.sigma_px[data.seen] ** 2).mean())) * labels.factor
        for data, labels in zip(found.readings, found.sensors, strict=True)
    )
    return LabelReport(
        tuple(findings), sigma, tuple(labels.probability() for labels in found.sensors)
    )


def _finding(
    kind: LabelErrorKind,
    sensor: str | None,
    points: tuple[int, ...],
    probability: float,
    miss: "_Miss",
) -> LabelFinding:
    counted = tuple(point + 1 for point in points)
    return LabelFinding(kind, sensor, counted, probability, miss.px, miss.in_sigma)


def _errors(
    hypothesis: Hypothesis,
) -> Iterator[tuple[LabelErrorKind, tuple[int, ...], Hypothesis]]:
    for cycle in sorted(hypothesis.cycles):
        yield "exchanged", cycle, Hypothesis(cycles=frozenset({cycle}))
    for moved in sorted(hypothesis.moved):
        yield "missing", moved, Hypothesis(moved=frozenset({moved}))
    for point in sorted(hypothesis.wrong):
        yield "wrong", (point,), Hypothesis(wrong=frozenset({point}))


@dataclass(frozen=True)
class _Miss:
    px: tuple[float | None, ...]
    in_sigma: tuple[float | None, ...]


def _missed(
    labels: SensorLabels, data: SensorReadings, labelled_px: Array, points: Sequence[int]
) -> _Miss:
    """Return by how much readings miss what the camera of an explanation reads at points."""
    best = labels.best
    fitted, slopes = data.camera.linearised(best.theta[None])
    covariance = _covariance(data, labels)
    usual = float(np.median(data.sigma_px[data.seen]))
    px: list[float | None] = []
    in_sigma: list[float | None] = []
    for point in points:
        off = float(labelled_px[point] - fitted[0, point])
        if np.isnan(off):
            px.append(None)
            in_sigma.append(None)
            continue
        slope = slopes[0, point]
        own = float(data.sigma_px[point]) if np.isfinite(data.readings_px[point]) else usual
        deviation = float(np.sqrt(own**2 + slope @ covariance @ slope)) * labels.factor
        px.append(off)
        in_sigma.append(off / deviation)
    return _Miss(tuple(px), tuple(in_sigma))
