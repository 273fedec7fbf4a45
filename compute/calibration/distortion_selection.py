"""Selection of distortion terms by cross-validation over blocks of space."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.calibration.assessment.cross_validation import block_count, spatial_block_index
from compute.calibration.assessment_result import CandidateTerms, DistortionSelection
from compute.calibration.settings import Loss
from compute.calibration.single_sensor.camera_fit import LensOffsets, minimise_with_distortion
from compute.calibration.single_sensor.distortion_terms import (
    AUTO_CANDIDATES,
    free_parameters,
    preset_terms,
)
from compute.calibration.single_sensor.sensor_fits import (
    ControlObservations,
    SensorFits,
    fit_distorted,
    residual_sigma,
)
from compute.camera.field_distortion import Term
from compute.camera.model import SensorModel
from compute.camera.stack import CameraStack
from compute.errors import DegeneratePoints, NoConvergence, TooFewPoints
from compute.progress import Progress

Array = NDArray[np.float64]

MIN_SPARE_READINGS: Final = 3
"""Readings of a sensor more than parameters that each fit without a block must have."""
MAX_LOSS_SIGMA: Final = 6.0
"""Prediction error over sigma at which a robust loss is clipped."""


@dataclass(frozen=True, eq=False)
class _ScoredTerms:
    """Prediction errors of one candidate set of terms."""

    name: str
    terms: tuple[tuple[Term, ...], ...]
    reduced_terms: tuple[tuple[str, str], ...]
    errors_px: Array


def select_terms(
    observed: ControlObservations,
    undistorted: tuple[SensorModel, ...],
    weights: Array,
    lens_offsets: LensOffsets,
    loss: Loss,
    progress: Progress | None = None,
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
        weights: of the readings by a robust loss, shape (N, S); ones without.
        lens_offsets: positions of the lenses along the slits.
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
    fits = SensorFits(undistorted, weights, lens_offsets)
    for number, name in enumerate(names):
        if progress is not None:
            progress(number / len(names), f"cross-validation of distortion {name}")
        terms, reduced_terms = _supported_terms(observed, folds, name, names)
        note = ""
        if all(own == () for own in terms) and name != "none":
            note = "too few points for it"
        elif any(terms == other.terms for other in scored):
            note = "too few points for more than a smaller set"
        else:
            try:
                fitted = fit_distorted(observed, undistorted, terms, lens_offsets, loss, weights)
                errors = _prediction_errors(observed, fitted, folds, blocks)
                scored.append(_ScoredTerms(name, terms, reduced_terms, errors))
                fits = fitted
            except (DegeneratePoints, NoConvergence, TooFewPoints) as error:
                note = error.detail
        rows.append(_unfitted_candidate(name, note))
    if not scored:
        none = ((),) * len(undistorted)
        return none, DistortionSelection("none", _reason_unjudged(rows), tuple(rows), count)
    sigma = _reading_sigma(observed, fits)
    losses = [_losses(one.errors_px, sigma, loss) for one in scored]
    readings = int(observed.seen.sum())
    totals = np.array([values.sum() / readings for values in losses])
    best = int(totals.argmin())
    excess = totals - totals[best]
    standard_errors = np.array(
        [_standard_error(values - losses[best], blocks, count, readings) for values in losses]
    )
    order = sorted(range(len(scored)), key=lambda one: _parameters(scored[one].terms))
    chosen = first_within_standard_error(order, excess, standard_errors)
    table = []
    for row in rows:
        found = next((k for k, one in enumerate(scored) if one.name == row.name), None)
        if found is None:
            table.append(row)
            continue
        table.append(
            CandidateTerms(
                row.name,
                row.terms,
                row.parameters,
                float(np.sqrt(np.nanmean(scored[found].errors_px ** 2))),
                float(totals[found]),
                float(excess[found]),
                float(standard_errors[found]),
            )
        )
    taken = scored[chosen]
    reason = _reason(
        taken.name, scored[best].name, float(excess[chosen]), float(standard_errors[chosen])
    )
    return taken.terms, DistortionSelection(
        taken.name, reason, tuple(table), count, taken.reduced_terms
    )


def first_within_standard_error(order: Sequence[int], excess: Array, error: Array) -> int:
    """Return the first candidate whose excess loss is within its standard error.

    Args:
        order: indices of the candidates, in order of preference.
        excess: loss above the lowest, shape (C,).
        error: standard error of that excess, shape (C,).
    """
    return next(one for one in order if excess[one] <= error[one])


def _unfitted_candidate(name: str, note: str) -> CandidateTerms:
    terms = () if name == "none" else preset_terms(name)
    return CandidateTerms(name, terms, free_parameters(terms), None, None, None, None, note)


def _supported_terms(
    observed: ControlObservations, folds: NDArray[np.bool_], name: str, names: tuple[str, ...]
) -> tuple[tuple[tuple[Term, ...], ...], tuple[tuple[str, str], ...]]:
    """Return each sensor's terms: those of the set, or of a smaller one where points are few."""
    sets = [
        (candidate, () if candidate == "none" else preset_terms(candidate)) for candidate in names
    ]
    sets = sets[: names.index(name) + 1]
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
    index = np.tile(np.arange(sensors), count)
    left = np.repeat(folds, sensors, axis=0).T
    weights = (observed.weights * np.sqrt(fits.weights))[:, index] * left
    ended = minimise_with_distortion(
        CameraStack.of(fits.models).rows(index),
        observed.points_mm,
        observed.readings_px[:, index],
        weights,
        fits.lens_offsets.prior.rows(index),
        multi_start=False,
    )
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


def _reading_sigma(observed: ControlObservations, fits: SensorFits) -> Array:
    """Return the readings' standard deviations (N, S), given or from the largest fit."""
    if observed.sigma_known:
        return observed.sigma_px
    sigma = residual_sigma(observed, fits.models, fits.weights)
    return np.broadcast_to(sigma, observed.readings_px.shape)


def _losses(errors_px: Array, sigma_px: Array, loss: Loss) -> Array:
    """Return squared prediction errors over the variance, summed over sensors, shape (N,)."""
    squares = np.nan_to_num((errors_px / sigma_px) ** 2)
    if loss == "robust":
        squares = np.minimum(squares, MAX_LOSS_SIGMA**2)
    total: Array = squares.sum(axis=1)
    return total


def _standard_error(
    differences: Array, blocks: NDArray[np.intp], count: int, readings: int
) -> float:
    sums = np.bincount(blocks, weights=differences, minlength=count)
    return float(np.sqrt(count / (count - 1) * ((sums - sums.mean()) ** 2).sum()) / readings)


def _parameters(terms: tuple[tuple[Term, ...], ...]) -> int:
    return sum(free_parameters(own) for own in terms)


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
