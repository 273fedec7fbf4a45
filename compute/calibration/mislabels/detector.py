"""Detection of label errors in control data: readings that carry the label of another point."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from math import log, pi
from statistics import median
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2 as chi2_distribution

from compute.calibration.mislabels.device_search import DeviceExplanation, search_device
from compute.calibration.mislabels.evaluation import SensorReadings
from compute.calibration.mislabels.finding import LabelErrorKind, LabelFinding
from compute.calibration.mislabels.hypothesis import Hypothesis
from compute.calibration.mislabels.lens_fit import with_lens
from compute.calibration.mislabels.marginal_likelihood import KNOWN_SIGMA, ScalePrior
from compute.calibration.mislabels.sensor_search import (
    SensorExplanation,
    contradicts_sigma,
    search_sensor_labels,
)
from compute.camera.model import SensorGeometry
from compute.camera.observation_checks import check_control_points
from compute.progress import Progress


@dataclass(frozen=True)
class LabelReport:
    """The label errors of a device's control data.

    Args:
        findings: the errors, those of all sensors first, then sensor by sensor.
        sigma_px: estimated standard deviation of a reading, one for each sensor [px].
        explanation_probability: for each sensor, posterior probability of its findings together;
            low where other explanations fit about as well.
    """

    findings: tuple[LabelFinding, ...]
    sigma_px: tuple[float, ...]
    explanation_probability: tuple[float, ...]


Array = NDArray[np.float64]

UNKNOWN_SIGMA: Final = ScalePrior(1.0, 0.3)
"""Prior of an unknown noise in pixels: weakly, a pixel's quantisation."""
UNKNOWN_SIGMA_FACTOR: Final = ScalePrior(1.0, 3.0)
"""Prior of the factor of standard deviations that the readings contradict."""
POOLED_READINGS: Final = 6.0
"""Weight, in readings, of the other sensors' noise as a prior of one's."""
LOG_ALTERNATIVE_PRIOR: Final = log(1e-4)
"""Log prior probability of a wrong common factor of the standard deviations, or of a lens with
distortion that does not contradict them everywhere."""
SUSPICIOUS_P_VALUE: Final = 1e-4
"""p-value of the best hypothesis's sum of squares below which these are tried."""


def find_label_errors(
    points_mm: Array,
    readings_px: Array,
    sensors: Sequence[SensorGeometry],
    sigma_px: Array | None = None,
    progress: Progress | None = None,
) -> LabelReport:
    """Find wrong, missing and exchanged labels; the data are not changed.

    For each sensor, hypotheses (sets of wrong readings and of exchanged labels) are compared by
    their posterior probability under a seven-parameter camera: right readings are normally
    distributed, wrong ones uniformly over the sensor. The search starts from least trimmed squares,
    continues in the linearised camera, where leaving out or exchanging readings changes the sum of
    squares in closed form, and ends with fits of the camera itself. An exchange that is likelier
    for all sensors together is one of the points.

    Not detectable: exchanged readings within a few standard deviations of each other, and a wrong
    reading of a point that the others hardly predict.

    Args:
        points_mm: control points, shape (N, 3) [mm].
        readings_px: readings, shape (N, S) [px]; NaN where a sensor did not see the point.
        sensors: the device's sensors in order.
        sigma_px: standard deviations of the readings, shape (N, S) [px]. None: one for each sensor,
            unknown but similar. Where most readings contradict the given ones, a lens with
            distortion is tried (with two readings a parameter at least), then a common factor.
        progress: called with the fraction done and the stage.

    Raises:
        TooFewPoints, DegeneratePoints: the points leave parameters open.
        NonFiniteValue, DuplicatePoint, ReadingOutsideSensor, InvalidParameter: a value is wrong.
    """
    points = np.asarray(points_mm, dtype=np.float64)
    readings = np.asarray(readings_px, dtype=np.float64)
    known_sigma = None if sigma_px is None else np.asarray(sigma_px, dtype=np.float64)
    check_control_points(points, readings, sensors, known_sigma)
    sigma = (
        np.ones(readings.shape)
        if known_sigma is None
        else np.where(np.isfinite(readings), known_sigma, 1)
    )
    data = [
        SensorReadings(
            points,
            readings[:, column],
            sigma[:, column],
            sensor,
            UNKNOWN_SIGMA if known_sigma is None else KNOWN_SIGMA,
        )
        for column, sensor in enumerate(sensors)
    ]
    names = [sensor.name for sensor in sensors]

    found: list[SensorExplanation] = []
    for column, one in enumerate(data):
        if progress is not None:
            progress(column / len(data), f"labels of {names[column]}")
        data[column], labels = _search_sensor(one)
        found.append(labels)
    if known_sigma is None:
        chosen = list(zip(data, found, strict=True))
        usual = ScalePrior(POOLED_READINGS, median(labels.factor for _, labels in chosen))
        data = [replace(one, scale=usual) for one, _ in chosen]
        found = [search_sensor_labels(one) for one in data]
    return _report(search_device(data, found), readings, names)


def _search_sensor(data: SensorReadings) -> tuple[SensorReadings, SensorExplanation]:
    """Search one sensor's labels with the camera that explains its readings best.

    A camera without distortion where that leaves nothing to explain. Otherwise a lens with
    distortion is tried, and where neither agrees with the given standard deviations, a common
    factor of these: where distortion is many standard deviations, no number of wrong readings
    explains it well.
    """
    stated = data.scale is KNOWN_SIGMA
    misfit = stated and contradicts_sigma(data)
    plain: tuple[SensorReadings, SensorExplanation] | None = None
    if not misfit:
        plain = data, search_sensor_labels(data)
        if stated and not _needs_alternatives(*plain):
            return plain
    lens_search = _search_with_lens(data)
    if plain is None:
        if lens_search is not None and not contradicts_sigma(lens_search[0]):
            return lens_search
        free = replace(data if lens_search is None else lens_search[0], scale=UNKNOWN_SIGMA_FACTOR)
        return free, search_sensor_labels(free)
    ranked = [(_schwarz_criterion(*plain), plain)]
    if lens_search is not None:
        ranked.append((_schwarz_criterion(*lens_search) + LOG_ALTERNATIVE_PRIOR, lens_search))
    if stated:
        free = replace(data, scale=UNKNOWN_SIGMA_FACTOR)
        labels = search_sensor_labels(free)
        ranked.append((_schwarz_criterion(free, labels) + LOG_ALTERNATIVE_PRIOR, (free, labels)))
    return max(ranked, key=lambda entry: entry[0])[1]


def _needs_alternatives(data: SensorReadings, labels: SensorExplanation) -> bool:
    """Return whether the best hypothesis has errors, or a sum of squares that is too large."""
    best = labels.best
    limit = chi2_distribution.isf(SUSPICIOUS_P_VALUE, max(best.kept - data.camera.width, 1))
    return best.hypothesis.size > 0 or bool(best.chi2 > limit)


def _search_with_lens(data: SensorReadings) -> tuple[SensorReadings, SensorExplanation] | None:
    """Search with a lens; once more with the lens of the repaired readings."""
    lens_search = with_lens(data)
    if lens_search is None:
        return None
    if data.scale is KNOWN_SIGMA and contradicts_sigma(lens_search):
        lens_search = replace(lens_search, scale=UNKNOWN_SIGMA_FACTOR)
    labels = search_sensor_labels(lens_search)
    if labels.best.hypothesis.size > 0:
        again = with_lens(data, labels.best.hypothesis)
        if again is not None:
            again = replace(again, scale=lens_search.scale)
            return again, search_sensor_labels(again)
    return lens_search, labels


def _schwarz_criterion(data: SensorReadings, labels: SensorExplanation) -> float:
    """Return the best hypothesis's log posterior, comparable between camera models."""
    best, width = labels.best, data.camera.width
    sign, log_determinant = np.linalg.slogdet(np.linalg.inv(_covariance(data, labels)))
    return float(
        best.log_posterior + 0.5 * log_determinant - 0.5 * width * log(2.0 * pi * best.kept)
        if sign > 0.0
        else -np.inf
    )


def _covariance(data: SensorReadings, labels: SensorExplanation) -> Array:
    """Return the covariance of the camera's parameters under the best hypothesis."""
    _, jacobian = data.camera.linearise(labels.best.theta[None])
    repaired, sigma = labels.best.hypothesis.repair(data.readings_px, data.sigma_px)
    kept = np.isfinite(repaired)
    weighted = jacobian[0, kept] / sigma[kept, None]
    return np.asarray(np.linalg.inv(weighted.T @ weighted))


def _report(found: DeviceExplanation, readings_px: Array, names: Sequence[str]) -> LabelReport:
    findings: list[LabelFinding] = []
    for exchange in found.common:
        residuals = [
            _label_residuals(labels, data, readings_px[:, column], exchange.pair)
            for column, (data, labels) in enumerate(zip(found.readings, found.sensors, strict=True))
        ]
        most = max(residuals, key=lambda residual: max(abs(s or 0.0) for s in residual.normalised))
        findings.append(_finding("exchanged", None, exchange.pair, exchange.probability, most))
    for name, data, labels in zip(names, found.readings, found.sensors, strict=True):
        for kind, points, error in _errors(labels.best.hypothesis):
            residual = _label_residuals(labels, data, data.readings_px, points)
            findings.append(_finding(kind, name, points, labels.probability(error), residual))
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
    residual: "_LabelResiduals",
) -> LabelFinding:
    counted = tuple(point + 1 for point in points)
    return LabelFinding(kind, sensor, counted, probability, residual.px, residual.normalised)


def _errors(
    hypothesis: Hypothesis,
) -> Iterator[tuple[LabelErrorKind, tuple[int, ...], Hypothesis]]:
    for cycle in sorted(hypothesis.cycles):
        yield "exchanged", cycle, Hypothesis(cycles=frozenset({cycle}))
    for reassigned in sorted(hypothesis.reassigned):
        yield "missing", reassigned, Hypothesis(reassigned=frozenset({reassigned}))
    for point in sorted(hypothesis.wrong):
        yield "wrong", (point,), Hypothesis(wrong=frozenset({point}))


@dataclass(frozen=True)
class _LabelResiduals:
    px: tuple[float | None, ...]
    normalised: tuple[float | None, ...]


def _label_residuals(
    labels: SensorExplanation, data: SensorReadings, labelled_px: Array, points: Sequence[int]
) -> _LabelResiduals:
    """Return by how much readings miss what the camera of an explanation reads at points."""
    best = labels.best
    fitted, jacobian = data.camera.linearise(best.theta[None])
    covariance = _covariance(data, labels)
    usual = float(np.median(data.sigma_px[data.seen]))
    px: list[float | None] = []
    normalised: list[float | None] = []
    for point in points:
        off = float(labelled_px[point] - fitted[0, point])
        if np.isnan(off):
            px.append(None)
            normalised.append(None)
            continue
        gradient = jacobian[0, point]
        own = float(data.sigma_px[point]) if np.isfinite(data.readings_px[point]) else usual
        sigma = float(np.sqrt(own**2 + gradient @ covariance @ gradient)) * labels.factor
        px.append(off)
        normalised.append(off / sigma)
    return _LabelResiduals(tuple(px), tuple(normalised))
