"""Search for one sensor's label errors: candidates in the linearised camera, tests in the full."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations, permutations, product
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2 as chi2_distribution

from compute.calibration.mislabels.beam_search import BEAM_WIDTH, LinearisedCamera, beam_search
from compute.calibration.mislabels.evaluation import (
    FIT_STEPS,
    EvaluatedHypothesis,
    SensorReadings,
    evaluate,
)
from compute.calibration.mislabels.hypothesis import Hypothesis

Array = NDArray[np.float64]

EVALUATED_PER_SEARCH: Final = 12
"""Hypotheses of a linearised search that are evaluated with the full camera."""
EVALUATED_IN_LAST_SEARCH: Final = 40
"""The same in the last search, on which the probabilities are based."""
CLEAN_BEAM_WIDTH: Final = 6
"""Beam width for readings without apparent outliers."""
MAX_ROUNDS: Final = 8
CLEAN_P_VALUE_THRESHOLD: Final = 1e-3
"""p-value of the sum of squares below which a sensor is not clean."""
OUTLIER_SIGMA_THRESHOLD: Final = 5.0
"""Normalised residual of a robust start beyond which a reading is an outlier."""
SIGMA_RATIO_THRESHOLD: Final = 3.0
"""Noise of the better-fitting half over the given sigma from which sigma is rejected."""
MANY_OUTLIERS_COUNT_THRESHOLD: Final = 8
MANY_OUTLIERS_SHARE_THRESHOLD: Final = 0.2
"""More outliers than this number and share cannot be a few label errors."""
MAX_REASSIGNMENTS: Final = 200


@dataclass(eq=False)
class _HypothesisPool:
    """The hypotheses evaluated so far."""

    data: SensorReadings
    evaluated: dict[Hypothesis, EvaluatedHypothesis] = field(default_factory=dict)

    @property
    def best(self) -> EvaluatedHypothesis:
        return max(self.evaluated.values(), key=lambda one: one.log_posterior)

    def evaluate(self, hypotheses: Iterable[Hypothesis], theta: Array) -> None:
        """Fit the camera under each hypothesis from ``theta`` (width,) and keep the better fit."""
        for one in evaluate(self.data, list(dict.fromkeys(hypotheses)), theta):
            before = self.evaluated.get(one.hypothesis)
            if before is None or one.log_posterior > before.log_posterior:
                self.evaluated[one.hypothesis] = one

    def search_nearby(
        self, theta: Array, seeds: Sequence[Hypothesis], count: int, beam: int = BEAM_WIDTH
    ) -> None:
        """Search in the camera linearised at ``theta`` and evaluate the best found."""
        data = self.data
        measured = data.observed_mask
        fitted, jacobian = data.camera.linearise(theta[None])
        sigma = data.sigma_px[measured]
        basis = np.linalg.qr(jacobian[0, measured] / sigma[:, None])[0]
        row_of = {int(point): index for index, point in enumerate(measured)}
        local = [h for h in (_renamed(seed, row_of) for seed in seeds) if h is not None]
        camera = LinearisedCamera(
            basis, fitted[0, measured], data.readings_px[measured], sigma, data.evidence
        )
        back = {index: point for point, index in row_of.items()}
        hypotheses = [
            _renamed(h, back) for _, h in beam_search(camera, [Hypothesis(), *local], count, beam)
        ]
        self.evaluate([h for h in hypotheses if h is not None], theta)


@dataclass(frozen=True, eq=False)
class SensorExplanation:
    """The best hypothesis of one sensor's readings and its alternatives.

    Args:
        best: the best one.
        evaluated: all that were evaluated, the best one among them.
        factor: posterior estimate of the common factor of the standard deviations.
    """

    best: EvaluatedHypothesis
    evaluated: tuple[EvaluatedHypothesis, ...]
    factor: float

    def probability(self, error: Hypothesis) -> float:
        """Return the posterior probability of these errors."""
        weights = np.exp([one.log_posterior - self.best.log_posterior for one in self.evaluated])
        holds = [
            error.outliers <= one.hypothesis.outliers
            and error.cycles <= one.hypothesis.cycles
            and error.reassigned <= one.hypothesis.reassigned
            for one in self.evaluated
        ]
        return float(weights[holds].sum() / weights.sum())


def search_sensor_labels(data: SensorReadings) -> SensorExplanation:
    """Find the hypothesis with the highest posterior probability for a sensor's readings.

    The search starts at the least-squares fit where all readings look ordinary, otherwise at robust
    starts too; then it continues around the best hypothesis until no better one is found.
    """
    pool, none = _without_errors(data), Hypothesis()
    ordinary = np.isinf(data.scale.dof) and _is_clean(pool)
    if ordinary:
        pool.search_nearby(pool.best.theta, [], EVALUATED_PER_SEARCH, CLEAN_BEAM_WIDTH)
    if not (ordinary and pool.best.hypothesis == none):
        searched: set[Hypothesis] = set()
        for start in data.robust:
            outliers = _outliers(data, start)
            if outliers not in searched:
                searched.add(outliers)
                pool.search_nearby(start, [outliers], EVALUATED_PER_SEARCH)
    last_searched: Hypothesis | None = none if ordinary else None
    for _ in range(MAX_ROUNDS):
        best = pool.best
        if best.hypothesis == last_searched:
            break
        last_searched = best.hypothesis
        pool.search_nearby(best.theta, [best.hypothesis], EVALUATED_IN_LAST_SEARCH)
        pool.evaluate(_reassignments(data, pool.best), pool.best.theta)
        pool.evaluate(_as_outliers(pool.best.hypothesis), pool.best.theta)
    best = pool.best
    return SensorExplanation(
        best, tuple(pool.evaluated.values()), data.evidence.factor(best.chi2, best.count)
    )


def contradicts_sigma(data: SensorReadings) -> bool:
    """Return whether the readings contradict their standard deviations or the camera model.

    Either the best-fitting half of the readings contradicts sigma, or it agrees and many of the
    others are outliers: more than a few label errors.
    """
    if _is_clean(_without_errors(data)):
        return False
    residuals, sigma_ratio = _residuals(data, data.robust[0])
    far = int((residuals > OUTLIER_SIGMA_THRESHOLD * max(sigma_ratio, data.scale.factor)).sum())
    return sigma_ratio > SIGMA_RATIO_THRESHOLD * data.scale.factor or far > max(
        MANY_OUTLIERS_COUNT_THRESHOLD, MANY_OUTLIERS_SHARE_THRESHOLD * len(residuals)
    )


def _without_errors(data: SensorReadings) -> _HypothesisPool:
    """Return the hypothesis without errors, by least squares of all readings."""
    pool, camera = _HypothesisPool(data), data.camera
    values = np.where(np.isfinite(data.readings_px), data.readings_px, camera.centre_px)[None]
    weights = np.where(np.isfinite(data.readings_px), 1.0 / data.sigma_px, 0.0)[None]
    plain = camera.fit(values, weights, camera.algebraic(values, weights), FIT_STEPS)[0]
    pool.evaluate([Hypothesis()], plain)
    return pool


def _is_clean(pool: _HypothesisPool) -> bool:
    best = pool.best
    return bool(
        best.chi2 / pool.data.scale.factor**2
        <= chi2_distribution.isf(
            CLEAN_P_VALUE_THRESHOLD, max(best.count - pool.data.camera.width, 1)
        )
    )


def _outliers(data: SensorReadings, theta: Array) -> Hypothesis:
    """Return the outliers of a robust start as a hypothesis."""
    measured = data.observed_mask
    residuals, sigma_ratio = _residuals(data, theta)
    sigma_ratio = max(sigma_ratio, data.scale.factor)
    order = np.argsort(-residuals, kind="stable")[: max(len(measured) - data.camera.width - 1, 0)]
    return Hypothesis(
        frozenset(
            int(measured[k]) for k in order if residuals[k] > OUTLIER_SIGMA_THRESHOLD * sigma_ratio
        )
    )


def _residuals(data: SensorReadings, theta: Array) -> tuple[Array, float]:
    """Return the normalised residuals of the readings, and the better half's RMS."""
    measured = data.observed_mask
    residuals = np.abs(data.camera.project(theta[None])[0, measured] - data.readings_px[measured])
    residuals = residuals / data.sigma_px[measured]
    most = (len(measured) + data.camera.width + 1) // 2
    nearest = np.sort(residuals)[:most]
    return residuals, float(np.sqrt((nearest**2).sum() / max(most - data.camera.width, 1)))


def _reassignments(data: SensorReadings, best: EvaluatedHypothesis) -> list[Hypothesis]:
    """Return hypotheses in which outliers belong to other points.

    In cycles of two or three, or to points without a reading; the most likely first.
    """
    outliers = sorted(best.hypothesis.outliers)
    fitted = data.camera.project(best.theta[None])[0]
    residuals = np.abs(data.readings_px[:, None] - fitted)  # reading labelled i, at point j
    assigned = {actual for _, actual in best.hypothesis.reassigned}
    unseen = np.flatnonzero(~np.isfinite(data.readings_px)).tolist()
    cycles = [*permutations(outliers, 3), *combinations(outliers, 2)]
    cycles = [cycle for cycle in cycles if cycle[0] == min(cycle)]
    reassigned = [pair for pair in product(outliers, unseen) if pair[1] not in assigned]
    worst = [max(map(residuals.item, cycle, cycle[1:] + cycle[:1])) for cycle in cycles]
    worst += [residuals.item(pair) for pair in reassigned]
    nearest = np.argsort(worst, kind="stable")[:MAX_REASSIGNMENTS].tolist()
    return [
        best.hypothesis.with_cycle(cycles[k])
        if k < len(cycles)
        else best.hypothesis.with_reassigned(*reassigned[k - len(cycles)])
        for k in nearest
    ]


def _as_outliers(best: Hypothesis) -> list[Hypothesis]:
    """Return hypotheses in which the readings of one label error are outliers, all or all but one.

    They are what an exchanged or wrong label competes with where the noise has a heavy tail.
    """
    hypotheses = []
    for error in sorted(best.cycles | best.reassigned):
        rest = best.without(error)
        readings = error[:1] if error in best.reassigned else error
        for excluded in range(len(readings) + 1):
            chosen = frozenset(readings[:excluded] + readings[excluded + 1 :])
            hypotheses.append(replace(rest, outliers=rest.outliers | chosen))
    return hypotheses


def _renamed(hypothesis: Hypothesis, names: dict[int, int]) -> Hypothesis | None:
    """Return the hypothesis with its points renumbered; None where one has no number."""
    if hypothesis.reassigned or not hypothesis.affected_points <= names.keys():
        return None
    renamed = Hypothesis(frozenset(names[point] for point in hypothesis.outliers))
    for cycle in hypothesis.cycles:
        renamed = renamed.with_cycle(names[point] for point in cycle)
    return renamed
