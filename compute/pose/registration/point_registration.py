"""Registration by paired points: transform, residuals of the fiducials, and errors of targets."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2 as chi_square

from compute.errors import (
    CollinearPoints,
    DuplicatePoint,
    InvalidParameter,
    NonFiniteValue,
    TooFewPoints,
)
from compute.pose.registration.absolute_orientation import (
    Similarity,
    SimilarityFit,
    fit_isotropic_similarity,
    fit_weighted_similarity,
)
from compute.pose.registration.correspondence_errors import (
    CorrespondenceErrors,
    find_correspondence_errors,
)
from compute.transform import Transform, finite_points

Array = NDArray[np.float64]

Weighting = Literal["covariances", "isotropic"]

MIN_HEIGHT: Final = 0.01
"""Smallest RMS off the fiducials' line over RMS along it that determines the rotation about it."""
_MAX_ROTATION_SIGMA_RAD: Final = 1.0 / 3.0
_UNIT: Final = np.eye(3)
_DUPLICATE_TOLERANCE: Final = 1e-6
_NEARLY_COLLINEAR: Final = 0.1
"""Fiducials flatter than this, as MIN_HEIGHT, are warned of."""
_MISFIT_PROBABILITY: Final = 1e-3


@dataclass(frozen=True, eq=False)
class Registration:
    """Transform from a source frame, such as an image's, to a target frame, such as the patient's.

    Args:
        transform: T_target_source with its covariance; without the scale.
        scale: lengths in the target over lengths in the source; 1 unless asked for.
        parameter_covariance: of rotation [rad], translation [mm] and, if it was free, log scale,
            shape (6, 6) or (7, 7).
        residual_mm: of each fiducial, shape (N, 3) [mm]; its length is the fiducial
            registration error (FRE).
        fre_mm: their RMS [mm].
        fle_mm: the fiducial localisation error that the residuals tell of, both sides together,
            RMS in space [mm].
        stated_fle_mm: what the covariances say [mm]; None: there were none.
        residual_sigma: root of chi2 per degree of freedom, about 1; None without covariances.
        correspondence_errors: what pairs are wrong and what would repair it; None: none is wrong.
        warnings: what to know before it is used, for a person.
    """

    transform: Transform
    scale: float
    parameter_covariance: Array
    residual_mm: Array
    fre_mm: float
    fle_mm: float
    stated_fle_mm: float | None
    residual_sigma: float | None
    correspondence_errors: CorrespondenceErrors | None
    warnings: tuple[str, ...]

    def apply(self, points_mm: Array) -> Array:
        """Return points (..., 3) of the source in the target's frame [mm]."""
        return self._similarity.apply(np.asarray(points_mm, dtype=np.float64))

    def target_covariance(self, targets_mm: Array) -> Array:
        """Return the covariance of ``apply`` at targets (..., 3), shape (..., 3, 3) [mm^2]."""
        targets = np.asarray(targets_mm, dtype=np.float64)
        jacobian = self._similarity.jacobian(targets, len(self.parameter_covariance) == 7)
        covariance: Array = jacobian @ self.parameter_covariance @ jacobian.swapaxes(-1, -2)
        return covariance

    def target_error(self, targets_mm: Array) -> Array:
        """Return the expected RMS target registration error (TRE), shape (...) [mm].

        It follows from the covariance of the transform. Where all fiducials have the same
        isotropic error, it equals the formula of J. M. Fitzpatrick, J. B. West and C. R. Maurer
        (doi:10.1109/42.736021).
        """
        covariance = self.target_covariance(targets_mm)
        sigma: Array = np.sqrt(np.trace(covariance, axis1=-2, axis2=-1))
        return sigma

    @property
    def _similarity(self) -> Similarity:
        return Similarity(self.transform.rotation, self.transform.translation_mm, self.scale)


def register_points(
    source_mm: Array,
    target_mm: Array,
    source_covariance_mm2: Array | None = None,
    target_covariance_mm2: Array | None = None,
    *,
    weighting: Weighting = "covariances",
    scaled: bool = False,
    names: Sequence[str] | None = None,
) -> Registration:
    """Return the transform of fiducials from the source to the target.

    Args:
        source_mm: shape (N, 3) [mm].
        target_mm: the same fiducials in the same order, shape (N, 3) [mm].
        source_covariance_mm2: of each, or one for all, shape (N, 3, 3) or (3, 3) [mm^2]; None:
            exact, if the target has covariances.
        target_covariance_mm2: likewise. Without either, all fiducials have the same isotropic
            error, estimated from the residuals.
        weighting: ``covariances``; or ``isotropic``: the closed form, whose result does not depend
            on the covariances; they are propagated to its own.
        scaled: whether the scale is free as well.
        names: names of the fiducials, for messages; None: their numbers from 1.

    Raises:
        TooFewPoints: fewer than three fiducials.
        DuplicatePoint: two fiducials coincide.
        CollinearPoints: they are collinear within their errors.
        InvalidParameter: an array is of a wrong shape, the numbers of points or names differ, or a
            covariance is not positive.
        NonFiniteValue: a value is not finite.
        NoConvergence: the weighted fit did not converge.
    """
    source, target = finite_points(source_mm, "the source"), finite_points(target_mm, "the target")
    count = len(source)
    if len(target) != count:
        raise InvalidParameter(f"{count} source points and {len(target)} target points; pair them")
    if names is not None and len(names) != count:
        raise InvalidParameter(f"{len(names)} names for {count} pairs; give one for each")
    called = tuple(str(one + 1) for one in range(count)) if names is None else tuple(names)
    if count < 3:
        raise TooFewPoints(
            f"{count} pairs of points; a registration needs at least 3 that are not on one line, "
            "and 4 to be checked",
            pairs=count,
            needed=3,
        )
    sigma_known = source_covariance_mm2 is not None or target_covariance_mm2 is not None
    source_covariances = _covariances(source_covariance_mm2, count, "source")
    target_covariances = _covariances(target_covariance_mm2, count, "target")
    _check_distinct(source, "source", called)
    _check_distinct(target, "target", called)
    both = source_covariances + target_covariances
    variance = np.trace(both, axis1=1, axis2=2) / 3.0
    if sigma_known and not (np.linalg.eigvalsh(both)[:, 0] > 0.0).all():
        raise InvalidParameter("the covariances of a pair, both sides added, must be positive")
    for points, side in ((source, "source"), (target, "target")):
        _check_not_collinear(points, side, float(np.sqrt(variance.mean())) if sigma_known else 0.0)
    fit = (
        fit_weighted_similarity(source, target, source_covariances, target_covariances, scaled)
        if sigma_known and weighting == "covariances"
        else _closed_form(
            source, target, scaled, source_covariances, target_covariances if sigma_known else _UNIT
        )
    )
    parameters = 7 if scaled else 6
    fle = fiducial_localisation_error(fit.residual_mm, parameters)
    covariance = fit.covariance if sigma_known else fit.covariance * fle**2 / 3.0
    dof = 3 * count - parameters
    shrunk = fit.similarity.scale * source if scaled else source
    correspondence_errors, others = find_correspondence_errors(
        shrunk, target, variance if sigma_known else None
    )
    similarity = fit.similarity
    warnings: list[str | None]
    if correspondence_errors is not None:
        warnings = [_wrong_pairs_message(correspondence_errors, called)]
    else:
        misfit = _misfit_message(fit.chi2, dof) if sigma_known else None
        warnings = [misfit, _symmetry_message(others, called)]
    warnings.append(_collinearity_message(source, covariance, sigma_known))
    return Registration(
        Transform(similarity.rotation, similarity.translation_mm, covariance[:6, :6]),
        similarity.scale,
        covariance,
        fit.residual_mm,
        float(np.sqrt((fit.residual_mm**2).sum(axis=1).mean())),
        fle,
        float(np.sqrt(3.0 * variance.mean())) if sigma_known else None,
        float(np.sqrt(fit.chi2 / dof)) if sigma_known else None,
        correspondence_errors,
        tuple(message for message in warnings if message is not None),
    )


def _covariances(covariances: Array | None, count: int, side: str) -> Array:
    if covariances is None:
        return np.zeros((count, 3, 3))
    covariance = np.asarray(covariances, dtype=np.float64)
    if covariance.shape not in ((3, 3), (count, 3, 3)):
        raise InvalidParameter(
            f"the {side}'s covariance has shape {covariance.shape}; it must be (3, 3) or "
            f"({count}, 3, 3)"
        )
    if not np.isfinite(covariance).all():
        raise NonFiniteValue(f"the {side}'s covariance has values that are not finite")
    if np.linalg.eigvalsh(covariance).min() < -1e-9 * np.abs(covariance).max():
        raise InvalidParameter(f"the {side}'s covariance is not positive")
    return np.broadcast_to(covariance, (count, 3, 3))


def _check_distinct(points: Array, side: str, names: Sequence[str]) -> None:
    apart = np.linalg.norm(points[:, None] - points, axis=2)
    length = apart.max()
    apart[np.tril_indices(len(points))] = np.inf
    first, second = divmod(int(np.argmin(apart)), len(points))
    if not apart[first, second] > _DUPLICATE_TOLERANCE * length:
        raise DuplicatePoint(
            f'fiducials "{names[first]}" and "{names[second]}" are at one position in the {side}, '
            f"{np.round(points[first], 3).tolist()}; give each once, its measurements averaged",
            pairs=[first, second],
        )


def _wrong_pairs_message(errors: CorrespondenceErrors, names: Sequence[str]) -> str:
    wrong = ", ".join(f'"{names[one]}"' for one in errors.pairs)
    falls = (
        f"the RMS residual falls from {errors.rms_before_mm:.3g} to {errors.rms_after_mm:.3g} mm"
    )
    if errors.kind == "exchanged":
        goes = ", ".join(f'"{names[one]}" to "{names[errors.order[one]]}"' for one in errors.pairs)
        return f"fiducials {wrong} are exchanged: {falls} with {goes}"
    if len(errors.pairs) == 1:
        return f"fiducial {wrong} is not where it should be: {falls} without it"
    return f"fiducials {wrong} are not where they should be: {falls} without them"


def _misfit_message(chi2: float, dof: int) -> str | None:
    if chi_square.sf(chi2, dof) >= _MISFIT_PROBABILITY:
        return None
    return (
        f"the residuals are {np.sqrt(chi2 / dof):.3g} standard deviations, which noise causes in "
        f"less than one of {1.0 / _MISFIT_PROBABILITY:.0f}, and no exchange or exclusion of pairs "
        "explains them: the covariances are too small, or something moved"
    )


def _symmetry_message(others: tuple[tuple[int, ...], ...], names: Sequence[str]) -> str | None:
    if not others:
        return None
    moved = ", ".join(f'"{names[one]}"' for one, goal in enumerate(others[0]) if one != goal)
    return (
        f"fiducials {moved} are placed so that they fit as well in another order: an exchange "
        "would not be seen; one more fiducial away from their symmetry would show it"
    )


def _collinearity_message(source: Array, covariance: Array, sigma_known: bool) -> str | None:
    along, off = principal_line(source)
    if off >= _NEARLY_COLLINEAR * along:
        return None
    rotation_sigma = float(np.sqrt(np.linalg.eigvalsh(covariance[:3, :3])[-1]))
    basis = "" if sigma_known else ", as estimated from the residuals"
    return (
        f"the fiducials are only {off:.3g} mm RMS off one line, along which they are spread "
        f"by {along:.4g} mm: the rotation about it is known to "
        f"{np.degrees(rotation_sigma):.2g} deg{basis}, and a target {along:.3g} mm from "
        f"the line is {rotation_sigma * along:.2g} mm off for it"
    )


def principal_line(points: Array) -> tuple[float, float]:
    """Return the RMS of points along their principal line, and off it [mm]."""
    values = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    along, off = np.array([values[0], np.hypot(values[1], values[2])]) / np.sqrt(len(points))
    return float(along), float(off)


def _check_not_collinear(points: Array, side: str, sigma_mm: float) -> None:
    along, off = principal_line(points)
    rotation_sigma = sigma_mm / (off * np.sqrt(len(points))) if off > 0.0 else np.inf
    if off >= MIN_HEIGHT * along and rotation_sigma <= _MAX_ROTATION_SIGMA_RAD:
        return
    needed = max(MIN_HEIGHT * along, sigma_mm / (_MAX_ROTATION_SIGMA_RAD * np.sqrt(len(points))))
    raise CollinearPoints(
        f"the fiducials in the {side} are {round(off, 9):.3g} mm RMS off one line, along which "
        f"they are spread by {along:.4g} mm RMS: the rotation about it is not known; they must be "
        f"at least {needed:.3g} mm off it",
        off_mm=off,
        along_mm=along,
        needed_mm=float(needed),
    )


def _closed_form(
    source: Array, target: Array, scaled: bool, source_covariances: Array, target_covariances: Array
) -> SimilarityFit:
    """Return the closed form, its covariance propagated from that of the pairs."""
    similarity = fit_isotropic_similarity(source, target, np.ones(len(source)), scaled)
    residual = similarity.apply(source) - target
    jacobian = similarity.jacobian(source, scaled)
    inverse = np.linalg.inv(np.einsum("nia,nib->ab", jacobian, jacobian))
    covariance = similarity.residual_covariance(source_covariances, target_covariances)
    propagated = np.einsum("nia,nij,njb->ab", jacobian, covariance, jacobian, optimize=True)
    information = np.linalg.inv(covariance)
    chi2 = float(np.einsum("ni,nij,nj->", residual, information, residual))
    return SimilarityFit(similarity, inverse @ propagated @ inverse, residual, chi2)


def fiducial_localisation_error(residuals_mm: Array, parameters: int = 6) -> float:
    """Return the fiducial localisation error (FLE, 3D RMS) estimated from N residuals [mm].

    ``FLE^2 = N / (N - 2) FRE^2`` (R. Sibson, doi:10.1111/j.2517-6161.1979.tb01076.x): a rigid
    motion takes up six of the 3 N degrees of freedom, a similarity seven.

    Args:
        residuals_mm: shape (N, 3) [mm].
        parameters: degrees of freedom of the transform.
    """
    dof = residuals_mm.size - parameters
    return float(np.sqrt(3.0 * (residuals_mm**2).sum() / dof))
