"""The label errors of one sensor: search in the linearised camera, judgement in the camera."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import combinations, permutations, product
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2 as chi2_distribution

from compute.calibration.mislabels.beam_search import BEAM_WIDTH, beam_search
from compute.calibration.mislabels.hypothesis import Hypothesis
from compute.calibration.mislabels.linearised_camera import LinearisedCamera
from compute.calibration.mislabels.marginal_likelihood import Evidence, ScalePrior
from compute.calibration.single_sensor.projective_camera import ProjectiveCamera
from compute.calibration.single_sensor.trimmed_least_squares import robust_starts
from compute.camera.model import SensorGeometry

Array = NDArray[np.float64]

EVALUATED_PER_SEARCH: Final = 12
"""Explanations of a linear search that are worked out in the camera itself."""
EVALUATED_IN_LAST_SEARCH: Final = 40
"""As many in the last one: what the probabilities rest on."""
CLEAN_BEAM_WIDTH: Final = 6
"""Beam where all squares look ordinary."""
ROBUST_STARTS: Final = 3
MAX_ROUNDS: Final = 8
FIT_STEPS: Final = 40
CLEAN_P_VALUE_THRESHOLD: Final = 1e-3
"""Chance that squares as large as a clean sensor's make it look twice."""
OUTLIER_SIGMA_THRESHOLD: Final = 5.0
"""Residuals of a robust start beyond this many of its deviations are its wrong readings."""
SIGMA_RATIO_THRESHOLD: Final = 3.0
"""Stated deviations are not believed where those of the nearer half are this many times larger."""
MANY_OUTLIERS_COUNT_THRESHOLD: Final = 8
MANY_OUTLIERS_SHARE_THRESHOLD: Final = 0.2
"""More readings than this, and this share of them, far off: no few labels."""
MAX_REASSIGNMENTS: Final = 200


@dataclass(frozen=True, eq=False)
class SensorReadings:
    """What the search is about: one sensor's readings of the control points.

    Args:
        points_mm: all control points, shape (N, 3).
        readings_px: shape (N,); NaN where not seen.
        sigma_px: deviations, shape (N,); of any value where not seen.
        sensor: its geometry.
        scale: what is known of a common factor of the deviations.
        extra, offset_px: what a lens adds to the camera, see ``ProjectiveCamera``.
    """

    points_mm: Array
    readings_px: Array
    sigma_px: Array
    sensor: SensorGeometry
    scale: ScalePrior
    extra: Array | None = None
    offset_px: Array | None = None

    @cached_property
    def seen(self) -> NDArray[np.intp]:
        """Points with a reading."""
        return np.flatnonzero(np.isfinite(self.readings_px))

    @cached_property
    def camera(self) -> ProjectiveCamera:
        """The camera's form for these points."""
        plain = ProjectiveCamera.of(self.points_mm, self.readings_px)
        return replace(plain, extra=self.extra, offset_px=self.offset_px)

    @cached_property
    def robust(self) -> Array:
        """Cameras that fit most of the readings, see ``robust_starts``."""
        return robust_starts(self.camera, self.readings_px, self.sigma_px, ROBUST_STARTS)

    @cached_property
    def evidence(self) -> Evidence:
        """Marginal likelihoods of explanations."""
        return Evidence(self.sensor.pixels, self.scale, self.camera.width)

    def exchanged(self, first: int, second: int) -> "SensorReadings":
        """Return them with the readings of two points exchanged."""
        readings, sigma = self.readings_px.copy(), self.sigma_px.copy()
        readings[[first, second]] = readings[[second, first]]
        sigma[[first, second]] = sigma[[second, first]]
        return replace(self, readings_px=readings, sigma_px=sigma)


@dataclass(frozen=True, eq=False)
class EvaluatedHypothesis:
    """An explanation, worked out: log posterior (up to the sensor's constant) and camera."""

    hypothesis: Hypothesis
    log_posterior: float
    theta: Array
    chi2: float
    kept: int


@dataclass(eq=False)
class _HypothesisPool:
    """Explanations judged so far."""

    data: SensorReadings
    evaluated: dict[Hypothesis, EvaluatedHypothesis] = field(default_factory=dict)

    @property
    def best(self) -> EvaluatedHypothesis:
        return max(self.evaluated.values(), key=lambda one: one.log_posterior)

    def evaluate(self, hypotheses: Iterable[Hypothesis], theta: Array) -> None:
        """Fit the camera under each explanation from ``theta`` (7,) and keep the better fit."""
        for one in evaluate(self.data, list(dict.fromkeys(hypotheses)), theta):
            before = self.evaluated.get(one.hypothesis)
            if before is None or one.log_posterior > before.log_posterior:
                self.evaluated[one.hypothesis] = one

    def search_nearby(
        self, theta: Array, seeds: Sequence[Hypothesis], count: int, beam: int = BEAM_WIDTH
    ) -> None:
        """Search in the camera linearised at ``theta`` and judge the best found."""
        data = self.data
        seen = data.seen
        fitted, jacobian = data.camera.linearise(theta[None])
        sigma = data.sigma_px[seen]
        basis = np.linalg.qr(jacobian[0, seen] / sigma[:, None])[0]
        place = {int(point): index for index, point in enumerate(seen)}
        local = [h for h in (_renamed(seed, place) for seed in seeds) if h is not None]
        camera = LinearisedCamera(
            basis, fitted[0, seen], data.readings_px[seen], sigma, data.evidence
        )
        back = {index: point for point, index in place.items()}
        found = [
            _renamed(h, back) for _, h in beam_search(camera, [Hypothesis(), *local], count, beam)
        ]
        self.evaluate([h for h in found if h is not None], theta)


@dataclass(frozen=True, eq=False)
class SensorExplanation:
    """The best explanation of one sensor's readings, and its rivals.

    Args:
        best: the best one.
        evaluated: all that were worked out, the best one among them.
        factor: of the stated deviations, after looking.
    """

    best: EvaluatedHypothesis
    evaluated: tuple[EvaluatedHypothesis, ...]
    factor: float

    def probability(self, error: Hypothesis | None = None) -> float:
        """Return the share of the explanations that hold these errors, or the best one's own."""
        weights = np.exp([one.log_posterior - self.best.log_posterior for one in self.evaluated])
        if error is None:
            return float(1.0 / weights.sum())
        holds = [
            error.wrong <= one.hypothesis.wrong
            and error.cycles <= one.hypothesis.cycles
            and error.reassigned <= one.hypothesis.reassigned
            for one in self.evaluated
        ]
        return float(weights[holds].sum() / weights.sum())


def search_sensor_labels(data: SensorReadings) -> SensorExplanation:
    """Find the explanation of a sensor's readings with the highest posterior probability.

    From the least squares of all readings where these look ordinary, otherwise from robust
    starts too; then around the best explanation until no better one is found.
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
    best = pool.best
    return SensorExplanation(
        best, tuple(pool.evaluated.values()), data.evidence.factor(best.chi2, best.kept)
    )


def contradicts_sigma(data: SensorReadings) -> bool:
    """Return whether even the camera that fits the nearer half of the readings contradicts sigma.

    Or agrees with it there, and leaves many readings far off. Then it is the deviations or the
    camera's form that is wrong, not a few labels.
    """
    if _is_clean(_without_errors(data)):
        return False
    residuals, sigma_ratio = _residuals(data, data.robust[0])
    far = int((residuals > OUTLIER_SIGMA_THRESHOLD * max(sigma_ratio, data.scale.factor)).sum())
    return sigma_ratio > SIGMA_RATIO_THRESHOLD * data.scale.factor or far > max(
        MANY_OUTLIERS_COUNT_THRESHOLD, MANY_OUTLIERS_SHARE_THRESHOLD * len(residuals)
    )


def _without_errors(data: SensorReadings) -> _HypothesisPool:
    """Return the explanation without errors, by least squares of all readings."""
    pool, camera = _HypothesisPool(data), data.camera
    values = np.where(np.isfinite(data.readings_px), data.readings_px, camera.centre_px)[None]
    weights = np.where(np.isfinite(data.readings_px), 1.0 / data.sigma_px, 0.0)[None]
    plain = camera.fit(values, weights, camera.algebraic(values, weights), FIT_STEPS)[0]
    pool.evaluate([Hypothesis()], plain)
    return pool


def evaluate(
    data: SensorReadings, hypotheses: Sequence[Hypothesis], theta: Array
) -> list[EvaluatedHypothesis]:
    """Fit the camera under each explanation, all at once, from one start (7,)."""
    if not hypotheses:
        return []
    repaired = [h.repair(data.readings_px, data.sigma_px) for h in hypotheses]
    readings = np.array([one for one, _ in repaired])
    kept = np.isfinite(readings)
    sigma = np.where(kept, np.array([one for _, one in repaired]), 1.0)
    weights = np.where(kept, 1.0 / sigma, 0.0)
    readings = np.where(kept, readings, data.camera.centre_px)
    starts = np.broadcast_to(theta, (len(hypotheses), data.camera.width))
    found = data.camera.fit(readings, weights, starts, FIT_STEPS)
    fitted, jacobian = data.camera.linearise(found)
    chi2 = (((fitted - readings) * weights) ** 2).sum(axis=1)
    weighted = jacobian * weights[..., None]
    sign, log_determinant = np.linalg.slogdet(weighted.swapaxes(1, 2) @ weighted)
    count = kept.sum(axis=1)
    unseen = len(data.readings_px) - len(data.seen)
    log_posterior = data.evidence.log_likelihood(
        chi2,
        count,
        log_determinant,
        np.log(sigma).sum(axis=1),
        np.array([len(h.wrong) for h in hypotheses]),
    ) + np.array([h.log_prior(len(data.seen), unseen) for h in hypotheses])
    return [
        EvaluatedHypothesis(
            hypothesis, float(log_posterior[row]), found[row], float(chi2[row]), int(count[row])
        )
        for row, hypothesis in enumerate(hypotheses)
        if sign[row] > 0.0 and count[row] > data.camera.width
    ]


def _is_clean(pool: _HypothesisPool) -> bool:
    best = pool.best
    return bool(
        best.chi2 / pool.data.scale.factor**2
        <= chi2_distribution.isf(
            CLEAN_P_VALUE_THRESHOLD, max(best.kept - pool.data.camera.width, 1)
        )
    )


def _outliers(data: SensorReadings, theta: Array) -> Hypothesis:
    """Return what a robust start takes for wrong, by its own residuals' deviation."""
    seen = data.seen
    residuals, sigma_ratio = _residuals(data, theta)
    sigma_ratio = max(sigma_ratio, data.scale.factor)
    order = np.argsort(-residuals, kind="stable")[: max(len(seen) - data.camera.width - 1, 0)]
    return Hypothesis(
        frozenset(
            int(seen[k]) for k in order if residuals[k] > OUTLIER_SIGMA_THRESHOLD * sigma_ratio
        )
    )


def _residuals(data: SensorReadings, theta: Array) -> tuple[Array, float]:
    """Return how far the readings seen are off a camera [deviations], and the nearer half's RMS."""
    seen = data.seen
    residuals = np.abs(data.camera.project(theta[None])[0, seen] - data.readings_px[seen])
    residuals = residuals / data.sigma_px[seen]
    most = (len(seen) + data.camera.width + 1) // 2
    nearest = np.sort(residuals)[:most]
    return residuals, float(np.sqrt((nearest**2).sum() / max(most - data.camera.width, 1)))


def _reassignments(data: SensorReadings, best: EvaluatedHypothesis) -> list[Hypothesis]:
    """Return explanations in which wrong readings belong to other points.

    To each other's in cycles of three, or to points without a reading; those first that the
    camera makes most likely.
    """
    wrong = sorted(best.hypothesis.wrong)
    fitted = data.camera.project(best.theta[None])[0]
    residuals = np.abs(data.readings_px[:, None] - fitted)  # reading labelled i, at point j
    taken = {own for _, own in best.hypothesis.reassigned}
    unseen = np.flatnonzero(~np.isfinite(data.readings_px)).tolist()
    cycles = [*permutations(wrong, 3), *combinations(wrong, 2)]
    cycles = [cycle for cycle in cycles if cycle[0] == min(cycle)]
    reassigned = [pair for pair in product(wrong, unseen) if pair[1] not in taken]
    worst = [max(map(residuals.item, cycle, cycle[1:] + cycle[:1])) for cycle in cycles]
    worst += [residuals.item(pair) for pair in reassigned]
    nearest = np.argsort(worst, kind="stable")[:MAX_REASSIGNMENTS].tolist()
    return [
        best.hypothesis.with_cycle(cycles[k])
        if k < len(cycles)
        else best.hypothesis.with_reassigned(*reassigned[k - len(cycles)])
        for k in nearest
    ]


def _renamed(hypothesis: Hypothesis, names: dict[int, int]) -> Hypothesis | None:
    """Return it with its points renamed; None where one has no name."""
    if hypothesis.reassigned or not hypothesis.affected_points <= names.keys():
        return None
    renamed = Hypothesis(frozenset(names[point] for point in hypothesis.wrong))
    for cycle in hypothesis.cycles:
        renamed = renamed.with_cycle(names[point] for point in cycle)
    return renamed
