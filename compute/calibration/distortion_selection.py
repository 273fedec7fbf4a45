"""Selection of distortion terms by cross-validation over blocks of space."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.calibration.assessment_result import CandidateTerms, DistortionSelection
from compute.calibration.settings import AUTO_CANDIDATES, Loss, free_parameters, preset_terms
from compute.calibration.single_sensor.sensor_fits import (
    ControlObservations,
    SensorFits,
    block_count,
    fit_distorted,
    residual_sigma,
    spatial_block_index,
)
from compute.camera.field_distortion import Term
from compute.errors import DegeneratePoints, NoConvergence, TooFewPoints
from compute.progress import Progress, no_progress

Array = NDArray[np.float64]

MIN_SPARE_READINGS: Final = 3
"""Readings of a sensor more than parameters that each fit without a block must have."""
MAX_LOSS_SIGMA: Final = 6.0
"""Prediction error over sigma at which a robust loss is clipped."""


@dataclass(frozen=True, eq=False)
class _ScoredTerms:
    """Prediction errors (N, S) [px] of one candidate set of terms, and their loss (N,)."""

    name: str
    terms: tuple[tuple[Term, ...], ...]
    reduced_terms: tuple[tuple[str, str], ...]
    errors_px: Array

    @property
    def parameters(self) -> int:
        return sum(free_parameters(terms) for terms in self.terms)


def select_terms(
    observed: ControlObservations,
    undistorted: SensorFits,
    loss: Loss,
    progress: Progress = no_progress,
) -> tuple[tuple[tuple[Term, ...], ...], DistortionSelection]:
    """Select one of ``AUTO_CANDIDATES``, or no terms, by cross-validation over blocks of space.

    One set serves the whole device, whose lenses are alike; a sensor with too few points for it
    takes the largest set that its points allow. Of all sets, the one with the fewest parameters is
    selected whose loss exceeds the lowest by no more than one standard error of their difference
    over the blocks (the one-standard-error rule of L. Breiman et al., "Classification and
    Regression Trees", 1984, for paired differences).

    Args:
        observed: control points and readings.
        undistorted: the seven-parameter cameras.
        loss: "linear" or "robust".
        progress: called with the fraction done and the candidate.

    Returns:
        The terms of each sensor, and the selection with its reason; no terms where nothing could be
        predicted.
    """
    count = block_count(len(observed.points_mm))
    blocks = spatial_block_index(observed.points_mm, count)
    folds = np.arange(count)[:, None] != blocks
    names = ("none", *AUTO_CANDIDATES)
    rows: list[CandidateTerms] = []
    scored: list[_ScoredTerms] = []
    fits = undistorted
    for number, name in enumerate(names):
        progress(number / len(names), f"cross-validation of distortion {name}")
        terms, reduced_terms = _supported_terms(observed, folds, name, names)
        note = ""
        if not any(terms) and name != "none":
            note = "too few points for it"
        elif any(terms == other.terms for other in scored):
            note = "too few points for more than a smaller set"
        else:
            try:
                fitted = fit_distorted(observed, undistorted, terms, loss)
                errors = _prediction_errors(observed, fitted, folds, blocks)
                scored.append(_ScoredTerms(name, terms, reduced_terms, errors))
                fits = fitted
            except (DegeneratePoints, NoConvergence, TooFewPoints) as refusal:
                note = refusal.detail
        full = preset_terms(name)
        rows.append(CandidateTerms(name, full, free_parameters(full), None, None, None, None, note))
    if not scored:
        none = ((),) * len(undistorted.models)
        return none, DistortionSelection("none", _reason_unjudged(rows), tuple(rows), count)
    sigma = observed.sigma_px
    if not observed.sigma_known:
        sigma = residual_sigma(observed, fits.models, fits.weights)
    losses = np.array([_losses(one.errors_px, sigma, loss) for one in scored])
    readings = int(observed.seen.sum())
    totals = losses.sum(axis=1) / readings
    best = int(totals.argmin())
    excess = totals - totals[best]
    errors = np.array(
        [_standard_error(row - losses[best], blocks, count, readings) for row in losses]
    )
    table = {row.name: row for row in rows}
    for one, total, more, error in zip(
        scored, totals.tolist(), excess.tolist(), errors.tolist(), strict=True
    ):
        table[one.name] = replace(
            table[one.name],
            left_out_rms_px=float(np.sqrt(np.nanmean(one.errors_px**2))),
            loss=total,
            loss_excess=more,
            loss_excess_error=error,
        )
    order = sorted(range(len(scored)), key=lambda one: scored[one].parameters)
    chosen = first_within_standard_error(order, excess, errors)
    selected = scored[chosen]
    reason = _reason(selected.name, scored[best].name, float(excess[chosen]), float(errors[chosen]))
    return selected.terms, DistortionSelection(
        selected.name, reason, tuple(table.values()), count, selected.reduced_terms
    )


def first_within_standard_error(order: Sequence[int], excess: Array, error: Array) -> int:
    """Return the first candidate whose excess loss is within its standard error.

    Args:
        order: indices of the candidates, in order of preference.
        excess: loss above the lowest, shape (C,).
        error: standard error of that excess, shape (C,).
    """
    return next(one for one in order if excess[one] <= error[one])


def _supported_terms(
    observed: ControlObservations, folds: NDArray[np.bool_], name: str, names: tuple[str, ...]
) -> tuple[tuple[tuple[Term, ...], ...], tuple[tuple[str, str], ...]]:
    """Return each sensor's terms: those of the set, or of a smaller one where points are few."""
    sets = [(smaller, preset_terms(smaller)) for smaller in names[: names.index(name) + 1]]
    terms, reduced_terms = [], []
    for sensor, rows in zip(observed.sensors, observed.seen.T, strict=True):
        fewest = int((folds & rows).sum(axis=1).min())
        supported = [
            candidate
            for candidate in sets
            if free_parameters(candidate[1]) + MIN_SPARE_READINGS <= fewest or not candidate[1]
        ]
        # The set itself, or the one with most parameters of those before it.
        selected = (
            supported[-1]
            if supported[-1][0] == name
            else max(supported, key=lambda candidate: len(candidate[1]))
        )
        terms.append(selected[1])
        if selected[0] != name:
            reduced_terms.append((sensor.name, selected[0]))
    return tuple(terms), tuple(reduced_terms)


def _prediction_errors(
    observed: ControlObservations,
    fits: SensorFits,
    folds: NDArray[np.bool_],
    blocks: NDArray[np.intp],
) -> Array:
    """Return predicted minus measured readings of fits without their block, (N, S) [px].

    Raises:
        NoConvergence: a fit without a block does not come to rest.
    """
    sensors, count = len(fits.models), len(folds)
    ended = fits.fit_without(observed, folds)
    if not ended.converged.all():
        where = int(np.flatnonzero(~ended.converged)[0])
        raise NoConvergence(
            f"without block {where // sensors + 1}, sensor "
            f"{observed.sensors[where % sensors].name} has no minimum"
        )
    fitted = ended.cameras.project(observed.points_mm).reshape(len(blocks), count, sensors)
    errors: Array = fitted[np.arange(len(blocks)), blocks] - observed.readings_px
    if np.isnan(errors[observed.seen]).any():
        raise NoConvergence("a left-out point lies behind a lens fitted without it")
    return errors


def _losses(errors_px: Array, sigma_px: Array, loss: Loss) -> Array:
    """Return squared prediction errors over the variance, summed over sensors, shape (N,)."""
    squares = np.nan_to_num((errors_px / sigma_px) ** 2)
    if loss == "robust":
        squares = np.minimum(squares, MAX_LOSS_SIGMA**2)
    return np.asarray(squares.sum(axis=1))


def _standard_error(
    differences: Array, blocks: NDArray[np.intp], count: int, readings: int
) -> float:
    sums = np.bincount(blocks, weights=differences, minlength=count)
    return float(np.sqrt(count / (count - 1) * ((sums - sums.mean()) ** 2).sum()) / readings)


def _reason_unjudged(rows: Sequence[CandidateTerms]) -> str:
    """Explain that no candidate, not even the one without terms, could be predicted."""
    bare = next(row.note for row in rows if row.name == "none")
    return (
        "no candidate could be judged by points of blocks that it never saw, so no terms are "
        f"taken; not even cameras without terms, as {bare}"
    )


def refusals(candidates: Sequence[CandidateTerms]) -> dict[str, list[str]]:
    """Return why candidates were not fitted: for each reason the names of the candidates."""
    found: dict[str, list[str]] = {}
    for one in candidates:
        if one.note:
            found.setdefault(one.note, []).append(one.name)
    return found


def _reason(chosen: str, best: str, excess: float, error: float) -> str:
    if chosen == best:
        return f"{chosen} predicts points of blocks that it never saw best, and with no fewer terms"
    return (
        f"{chosen} has the fewest parameters of the sets that predict points of blocks that they "
        f"never saw as well as the best, {best}, within one standard error (mean squared error "
        f"over variance larger by {excess:.3g}, standard error {error:.3g})"
    )
