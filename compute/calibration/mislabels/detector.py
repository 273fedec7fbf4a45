"""Detection of label errors in control data: readings that carry the label of another point."""

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from math import comb, exp, log, pi
from statistics import median
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2 as chi2_distribution

from compute.calibration.mislabels.evaluation import SensorReadings, evaluate, reading_errors
from compute.calibration.mislabels.hypothesis import (
    KNOWN_SIGMA,
    Hypothesis,
    NoiseTail,
    ScalePrior,
    estimate_tail,
    log_exchange_prior,
)
from compute.calibration.mislabels.lens_fit import with_lens
from compute.calibration.mislabels.repair import LabelErrorKind, LabelFinding
from compute.calibration.mislabels.sensor_search import (
    SensorExplanation,
    contradicts_sigma,
    search_sensor_labels,
)
from compute.camera.model import SensorGeometry
from compute.camera.observation_checks import check_control_points
from compute.progress import Progress, no_progress

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
COMMON_EXCHANGE_PROBABILITY: Final = 0.02
"""Prior probability that two points have each other's labels in all sensors."""
SEARCH_MARGIN: Final = 12.0
"""Log posterior below what is needed at which an exchange of points is not searched for."""
MIN_OUTLIER_PROBABILITY: Final = 0.5
"""Probability below which a reading is not reported as an outlier."""
SUSPICIOUS_P_VALUE: Final = 1e-4
"""p-value of the best hypothesis's sum of squares below which these are tried."""


@dataclass(frozen=True)
class LabelReport:
    """Label errors and outliers of a device's control data.

    Args:
        findings: what was found, those of all sensors first, then sensor by sensor.
        sigma_px: estimated standard deviation of a reading, one for each sensor [px].
    """

    findings: tuple[LabelFinding, ...]
    sigma_px: tuple[float, ...]


def find_label_errors(
    points_mm: Array,
    readings_px: Array,
    sensors: Sequence[SensorGeometry],
    sigma_px: Array | None = None,
    progress: Progress = no_progress,
) -> LabelReport:
    """Find exchanged and wrong labels, and outliers; the data are not changed.

    For each sensor, hypotheses (sets of label errors and of outliers) are compared by their
    posterior probability under a seven-parameter camera. The core of the noise is normal; outliers
    are gross errors anywhere on the sensor, or lie in the noise's tail, a power law that the
    readings of the other sensors determine. A label error must explain its readings better than
    that tail does; an error of five standard deviations or more that only the tail explains is an
    outlier. The search starts from least trimmed squares, continues in the linearised camera,
    where leaving out or exchanging readings changes the sum of squares in closed form, and ends
    with fits of the camera itself. An exchange that is likelier for all sensors together is one
    of the points.

    Not detectable: exchanged readings within a few standard deviations of each other, and an
    outlier at a point that the other readings hardly predict.

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
    given_sigma = None if sigma_px is None else np.asarray(sigma_px, dtype=np.float64)
    check_control_points(points, readings, sensors, given_sigma)
    sigma, scale = np.ones(readings.shape), UNKNOWN_SIGMA
    if given_sigma is not None:
        sigma, scale = np.where(np.isfinite(readings), given_sigma, 1.0), KNOWN_SIGMA
    data = [
        SensorReadings(points, readings[:, column], sigma[:, column], sensor, scale)
        for column, sensor in enumerate(sensors)
    ]
    explanations: list[SensorExplanation] = []
    for column, one in enumerate(data):
        progress(column / len(data), f"labels of {one.sensor.name}")
        data[column], labels = _search_sensor(one)
        explanations.append(labels)
    tails = _tails(data, explanations)
    if given_sigma is None:
        usual = ScalePrior(POOLED_READINGS, median(labels.factor for labels in explanations))
        data = [replace(one, scale=usual, tail=tail) for one, tail in zip(data, tails, strict=True)]
        explanations = [search_sensor_labels(one) for one in data]
    else:
        for column, labels in enumerate(explanations):
            if labels.best.hypothesis.size > 0:
                data[column] = replace(data[column], tail=tails[column])
                explanations[column] = search_sensor_labels(data[column])
    return _report(*_search_device(data, explanations), readings)


def _tails(data: list[SensorReadings], explanations: list[SensorExplanation]) -> list[NoiseTail]:
    """Return the noise's tail for each sensor, estimated from the readings of the others.

    A sensor's own readings are left out: exchanged ones would speak for a tail that explains them.
    """
    errors = [
        reading_errors(one, labels.best) for one, labels in zip(data, explanations, strict=True)
    ]
    tails = []
    for column in range(len(data)):
        others = [one for k, one in enumerate(errors) if k != column]
        normalised = np.concatenate([np.zeros(0), *(one.normalised for one in others)])
        gross = np.concatenate([np.zeros(0), *(one.gross_density for one in others)])
        tails.append(estimate_tail(normalised, gross))
    return tails


def _search_sensor(data: SensorReadings) -> tuple[SensorReadings, SensorExplanation]:
    """Search one sensor's labels with the camera that explains its readings best.

    A camera without distortion where that leaves nothing to explain. Otherwise a lens with
    distortion is tried, and where neither agrees with the given standard deviations, a common
    factor of these: where distortion is many standard deviations, no number of outliers
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
    limit = chi2_distribution.isf(SUSPICIOUS_P_VALUE, max(best.count - data.camera.width, 1))
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
        best.log_posterior + 0.5 * log_determinant - 0.5 * width * log(2.0 * pi * best.count)
        if sign > 0.0
        else -np.inf
    )


def _covariance(data: SensorReadings, labels: SensorExplanation) -> Array:
    """Return the covariance of the camera's parameters under the best hypothesis."""
    _, jacobian = data.camera.linearise(labels.best.theta[None])
    repaired, sigma = labels.best.hypothesis.repair(data.readings_px, data.sigma_px)
    used = np.isfinite(repaired)
    weighted = jacobian[0, used] / sigma[used, None]
    return np.asarray(np.linalg.inv(weighted.T @ weighted))


def _search_device(
    readings: list[SensorReadings], explanations: list[SensorExplanation]
) -> tuple[dict[tuple[int, int], float], list[SensorReadings], list[SensorExplanation]]:
    """Find exchanges that are likelier for the points than for single sensors.

    Returns:
        Pairs of points, counted from 0, with exchanged labels, and their probability; each
        sensor's readings once those are repaired, and what is left to explain of them.
    """
    common: dict[tuple[int, int], float] = {}
    refused: set[tuple[int, int]] = set()
    while pair := next((p for p in _exchanged_pairs(explanations) if p not in refused), None):
        refused.add(pair)
        prior = log(COMMON_EXCHANGE_PROBABILITY / comb(len(readings[0].points_mm), 2))
        expected_gain = prior + sum(
            _expected_gain(*each, pair) for each in zip(readings, explanations, strict=True)
        )
        if expected_gain < -SEARCH_MARGIN:
            continue
        swapped = [one.exchanged(*pair) for one in readings]
        after = [search_sensor_labels(one) for one in swapped]
        gain = prior + sum(
            new.best.log_posterior - old.best.log_posterior
            for new, old in zip(after, explanations, strict=True)
        )
        if gain > 0.0:
            common[pair] = 1.0 / (1.0 + exp(-min(gain, 700.0)))
            readings, explanations = swapped, after
    return common, readings, explanations


def _expected_gain(data: SensorReadings, labels: SensorExplanation, pair: tuple[int, int]) -> float:
    """Return the approximate gain of a sensor's best hypothesis when two points are exchanged."""
    best = labels.best
    exchange_prior = log_exchange_prior(len(data.observed_mask))
    if pair in best.hypothesis.cycles:
        return -exchange_prior
    if best.hypothesis.affected_points & set(pair):
        return SEARCH_MARGIN  # Its errors are mixed up with the pair: only a search can tell.
    evaluated = evaluate(data, [best.hypothesis.with_cycle(pair)], best.theta)
    return max(
        exchange_prior,
        evaluated[0].log_posterior - exchange_prior - best.log_posterior
        if evaluated
        else exchange_prior,
    )


def _exchanged_pairs(explanations: Sequence[SensorExplanation]) -> list[tuple[int, int]]:
    """Return the pairs exchanged in any sensor, those in most sensors first."""
    counted = Counter(
        (cycle[0], cycle[1])
        for labels in explanations
        for cycle in labels.best.hypothesis.cycles
        if len(cycle) == 2
    )
    return sorted(counted, key=lambda pair: (-counted[pair], pair))


def _report(
    common: dict[tuple[int, int], float],
    data: list[SensorReadings],
    explanations: list[SensorExplanation],
    readings_px: Array,
) -> LabelReport:
    findings: list[LabelFinding] = []
    sensors = list(zip(data, explanations, strict=True))
    for pair, probability in common.items():
        residuals = [
            _label_residuals(*sensor, readings_px[:, column], pair)
            for column, sensor in enumerate(sensors)
        ]
        largest = max(residuals, key=lambda residual: max(abs(s or 0.0) for s in residual[1]))
        counted = tuple(point + 1 for point in pair)
        findings.append(LabelFinding("exchanged", None, counted, probability, *largest))
    for one, labels in sensors:
        errors = reading_errors(one, labels.best)
        large = dict(zip(errors.points, errors.large.tolist(), strict=True))
        for kind, points, error in _errors(labels.best.hypothesis):
            probability = labels.probability(error)
            if kind == "outlier":
                probability *= large[points[0]]
                if probability < MIN_OUTLIER_PROBABILITY:
                    continue
            residual = _label_residuals(one, labels, one.readings_px, points)
            counted = tuple(point + 1 for point in points)
            findings.append(LabelFinding(kind, one.sensor.name, counted, probability, *residual))
    sigma = tuple(
        float(np.sqrt((one.sigma_px[one.observed_mask] ** 2).mean())) * labels.factor
        for one, labels in sensors
    )
    return LabelReport(tuple(findings), sigma)


def _errors(
    hypothesis: Hypothesis,
) -> Iterator[tuple[LabelErrorKind, tuple[int, ...], Hypothesis]]:
    for cycle in sorted(hypothesis.cycles):
        yield "exchanged", cycle, Hypothesis(cycles=frozenset({cycle}))
    for reassigned in sorted(hypothesis.reassigned):
        yield "wrong-label", reassigned, Hypothesis(reassigned=frozenset({reassigned}))
    for point in sorted(hypothesis.outliers):
        yield "outlier", (point,), Hypothesis(outliers=frozenset({point}))


def _label_residuals(
    data: SensorReadings, labels: SensorExplanation, labelled_px: Array, points: Sequence[int]
) -> tuple[tuple[float | None, ...], tuple[float | None, ...]]:
    """Return residuals of readings at points [px], and the same over their standard deviation.

    Relative to the camera of the best hypothesis; None without a reading.
    """
    fitted, jacobian = data.camera.linearise(labels.best.theta[None])
    covariance = _covariance(data, labels)
    usual = float(np.median(data.sigma_px[data.observed_mask]))
    px: list[float | None] = []
    normalised: list[float | None] = []
    for point in points:
        off = float(labelled_px[point] - fitted[0, point])
        if np.isnan(off):
            px.append(None)
            normalised.append(None)
            continue
        gradient = jacobian[0, point]
        reading_sigma = (
            float(data.sigma_px[point]) if np.isfinite(data.readings_px[point]) else usual
        )
        sigma = float(np.sqrt(reading_sigma**2 + gradient @ covariance @ gradient)) * labels.factor
        px.append(off)
        normalised.append(off / sigma)
    return tuple(px), tuple(normalised)
