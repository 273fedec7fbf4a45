"""Starting cameras from a wand's readings and its length alone."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from compute.calibration.bundle_adjustment.data_snooping import SIGMA_FLOOR_PX
from compute.calibration.bundle_adjustment.gauge import transform_world
from compute.calibration.bundle_adjustment.sensor_prior import SensorPrior
from compute.calibration.bundle_adjustment.solver import approximate_solution
from compute.calibration.self_calibration.coarse_solution import lens_offset_prior
from compute.calibration.self_calibration.initial_poses import (
    marker_distances,
    start_poses,
    triangulate,
)
from compute.calibration.self_calibration.metric_upgrade import (
    DISTANCE_SIGMA,
    POINT_SIGMA,
    metric_upgrades,
)
from compute.calibration.self_calibration.pose_screening import resect, screen_poses
from compute.calibration.self_calibration.projective_reconstruction import (
    MIN_READINGS,
    SEED,
    ProjectiveReconstruction,
    affine_start,
    dual,
    reconstruct_projective,
)
from compute.calibration.self_calibration.targets import Recording, Wand
from compute.camera.field_distortion import FieldDistortion, Term
from compute.camera.model import SensorGeometry, SensorModel, vector3
from compute.camera.stack import CameraStack
from compute.errors import LumilineError, NoConvergence, TooFewPoints
from compute.robust_statistics import MAD_TO_SIGMA

Array = NDArray[np.float64]

MAX_CANDIDATES: Final = 6
"""Metric solutions that are adjusted."""
ROUNDS: Final = 15
PRIOR_ROUNDS: Final = 2
"""Rounds in which lenses are held near one another and near the middle of their pixels."""
REFIT_NOISE: Final = (3.0, 10.0)
"""Noise, over that which the best cameras leave, from which all poses are fitted to them again."""
OUTLIER_LIMIT: Final = 5.0
"""Misfit of a point over its sigma beyond which it has a wrong reading."""
MISFIT_LIMIT: Final = 16.0
"""chi2 per reading beyond which a pose's misfit counts no more."""
HANDEDNESS_LIMIT: Final = 0.5
"""Smallest correlation with the described directions that settles the mirror image."""
DIFFERENCE: Final = 0.02
"""Relative difference of inner parameters from which cameras are others."""


@dataclass(frozen=True)
class UncalibratedStart:
    """Cameras from readings alone, or their mirror image.

    Args:
        models: the S cameras; the world's origin is the point nearest to the slits, z the mean
            optical axis, and x the first sensor's pixels, perpendicular to z.
        alternative_chi2: robust chi2 of the next best solution with other cameras minus this
            one's; inf where there is none.
    """

    models: tuple[SensorModel, ...]
    alternative_chi2: float


def uncalibrated_start(
    sensors: Sequence[SensorGeometry], recordings: Sequence[Recording], seed: int = SEED
) -> UncalibratedStart:
    """Compute S cameras without any initial values, for sensors that look the same way roughly.

    Affine factorisation, projective bundle adjustment, the dual of four cameras, a metric upgrade
    by the wand's length and metric adjustment. The best cameras are fitted to all poses again, also
    to those that they contradicted; the solution with the lowest cost counts. The mirror image fits
    as well; which one is returned is arbitrary, see ``handedness``.

    Args:
        sensors: names and pixels.
        recordings: of wands; others are not used.
        seed: of the random subsets and samples that are tried.

    Raises:
        TooFewPoints: fewer than four sensors, no wand, or too few markers read by four.
        NoConvergence: no cameras fit.
    """
    check_uncalibrated(len(sensors), recordings)
    wands = [one for one in recordings if isinstance(one.target, Wand)]
    fits = [_adjust(models, wands) for models in _metric_candidates(sensors, wands, seed)]
    candidates = [one for one in fits if one is not None]
    if not candidates:
        raise NoConvergence(
            "no cameras fit the readings and the wand's length; wave it in all directions, "
            "near and far, and check that its markers are told apart"
        )
    sigma = min(one.noise() for one in candidates)
    candidates.sort(key=lambda one: one.cost(sigma))
    refitted = [_refit_all_poses(candidates[0], wands, factor) for factor in REFIT_NOISE]
    candidates += [one for one in refitted if one is not None]
    sigma = min(one.noise() for one in candidates)
    candidates.sort(key=lambda one: one.cost(sigma))
    best = candidates[0]
    others = [
        one.cost(sigma) - best.cost(sigma)
        for one in candidates[1:]
        if _different(one.models, best.models)
    ]
    return UncalibratedStart(_device_frame(best.models), min(others, default=float("inf")))


def check_uncalibrated(sensors: int, recordings: Sequence[Recording]) -> None:
    """Check that cameras without initial values are possible.

    Args:
        sensors: number of sensors.
        recordings: the readings.

    Raises:
        TooFewPoints: fewer than four sensors, or no wand.
    """
    wands = any(isinstance(one.target, Wand) for one in recordings)
    if sensors < MIN_READINGS or not wands:
        what = f"{sensors} sensors" if wands else "no wand"
        raise TooFewPoints(
            f"{what}; cameras without initial values need four sensors and a wand's readings; "
            "give initial cameras",
            sensors=sensors,
        )


def _metric_candidates(
    sensors: Sequence[SensorGeometry], wands: Sequence[Recording], seed: int
) -> list[tuple[SensorModel, ...]]:
    readings = np.concatenate([one.readings_px.reshape(-1, len(sensors)) for one in wands])
    count = np.isfinite(readings).sum(axis=1)
    fit = count >= MIN_READINGS
    unknowns = 8 * len(sensors) - 15 - len(sensors)
    constraints = int((count[fit] - 3).sum())
    if constraints <= unknowns or (np.isfinite(readings[fit]).sum(axis=0) < MIN_READINGS).any():
        raise TooFewPoints(
            f"{int(fit.sum())} markers were read by four sensors or more, {constraints} readings "
            f"more than their positions need; {unknowns} is the least without initial cameras, "
            "and three times that is good",
            points=int(fit.sum()),
        )
    # Readings about their mean, in units of their scatter.
    centre, scale = np.nanmean(readings, axis=0), float(np.nanmean(np.nanstd(readings, axis=0)))
    normalised = (readings - centre) / scale
    start = reconstruct_projective(normalised[fit], seed)
    starts = [start, affine_start(normalised[fit], seed)]
    if len(sensors) == MIN_READINGS:
        starts.append(dual(start))
    to_pixels = np.zeros((len(sensors), 2, 2))
    to_pixels[:, 0, 0], to_pixels[:, 0, 1], to_pixels[:, 1, 1] = scale, centre, 1.0
    found: list[tuple[float, tuple[SensorModel, ...]]] = []
    misfit = start.point_misfits()
    usable = count >= 3
    usable[fit] = misfit <= OUTLIER_LIMIT * MAD_TO_SIGMA * np.median(misfit)
    pairs, lengths = _known_lengths(wands, usable)
    for one in starts:
        points = np.full((len(readings), 4), np.nan)
        points[usable] = one.triangulated(normalised[usable])
        cameras = to_pixels @ one.cameras
        number = np.cumsum(usable) - 1
        whole = ProjectiveReconstruction(cameras, points[usable], readings[usable])
        found += metric_upgrades(whole, number[pairs], lengths, sensors, seed)
    found.sort(key=lambda one: one[0])
    return [models for _, models in found[:MAX_CANDIDATES]]


def _known_lengths(
    wands: Sequence[Recording], usable: NDArray[np.bool_]
) -> tuple[NDArray[np.intp], Array]:
    """Return pairs of markers of known distance (M, 2) and the distances (M,)."""
    pairs, lengths = [], []
    first = 0
    for one in wands:
        poses, markers, _ = one.readings_px.shape
        ends = np.stack(np.triu_indices(markers, 1), axis=1)
        every = first + (markers * np.arange(poses))[:, None, None] + ends
        shape = one.target.shape() if isinstance(one.target, Wand) else None
        if shape is not None:
            pairs.append(every.reshape(-1, 2))
            lengths.append(np.tile(marker_distances(shape.marker_mm), poses))
        first += poses * markers
    pair, length = np.concatenate(pairs), np.concatenate(lengths)
    known = usable[pair].all(axis=1)
    return pair[known], length[known]


@dataclass(frozen=True, eq=False)
class _Adjusted:
    """Adjusted cameras and how their poses, fitted one by one, agree with the readings.

    Args:
        models: the S cameras.
        squares: squared residuals of each pose, shape (B,) [px^2]; inf: it cannot be placed.
        dof: degrees of freedom of each pose, shape (B,).
        count: its readings, shape (B,); 0 where too few markers are seen to place it.
    """

    models: tuple[SensorModel, ...]
    squares: Array
    dof: Array
    count: Array

    @classmethod
    def of(cls, models: tuple[SensorModel, ...], wands: Sequence[Recording]) -> "_Adjusted":
        squares, dof, count = [], [], []
        for one in wands:
            start = start_poses(models, one, np.ones(one.readings_px.shape))
            poses, chi2 = resect(models, start.poses)
            whole = np.full(len(one.readings_px), np.inf)
            whole[start.pose_index] = np.where(np.isfinite(chi2), chi2, np.inf)
            seen = np.isfinite(one.readings_px).sum(axis=2)
            squares.append(whole)
            dof.append(seen.sum(axis=1) - poses.unknowns)
            count.append(np.where((seen >= 3).sum(axis=1) >= 2, seen.sum(axis=1), 0))
        return cls(models, np.concatenate(squares), np.concatenate(dof), np.concatenate(count))

    def noise(self) -> float:
        """Return a robust estimate of the readings' noise over all poses [px]."""
        tested = (self.dof > 0) & (self.count > 0)
        if not tested.any():
            return float("inf")
        # Median of chi-square (Wilson and Hilferty, doi:10.1073/pnas.17.12.684).
        median = self.dof[tested] * (1.0 - 2.0 / (9.0 * self.dof[tested])) ** 3
        return float(np.sqrt(np.median(self.squares[tested] / median)))

    def cost(self, sigma: float) -> float:
        """Return the robust chi2 of all poses for a noise [px]."""
        limited = np.minimum(self.squares / sigma**2, MISFIT_LIMIT * self.count)
        return float(limited[self.count > 0].sum())


def _adjust(models: tuple[SensorModel, ...], wands: Sequence[Recording]) -> _Adjusted | None:
    """Return cameras adjusted until the noise no longer falls; None where that fails.

    Poses start anew every time: a few stuck ones look like a minimum of the cameras. In the first
    rounds lenses are held near one another and near the middle of their pixels.
    """
    sigma = 1.0
    distorted = any(model.distortion is not None for model in models)
    held_rounds = 0 if distorted else PRIOR_ROUNDS
    try:
        for number in range(ROUNDS):
            sets = []
            for one in wands:
                spread = np.full(one.readings_px.shape, sigma)
                start = screen_poses(models, start_poses(models, one, spread)).consistent
                if len(start.poses):
                    sets.append(start.poses)
            if not sets:
                return None
            prior = _lens_prior(models) if number < held_rounds else None
            if distorted:
                prior = lens_offset_prior(models, sets)
            models = approximate_solution(
                models, sets, prior=prior, free_datum=True, loss="robust"
            ).models
            found = _Adjusted.of(models, wands)
            previous, sigma = sigma, max(found.noise(), SIGMA_FLOOR_PX)
            if number >= held_rounds and abs(sigma - previous) < 0.02 * sigma:
                break
    except (LumilineError, np.linalg.LinAlgError):
        return None
    return found if np.isfinite(sigma) else None


def _refit_all_poses(
    found: _Adjusted, wands: Sequence[Recording], factor: float
) -> _Adjusted | None:
    """Return cameras adjusted to all poses, with noise that falls from an inflated one.

    Poses that wrong cameras contradict wait while these are adjusted, which then fit the others:
    the choice confirms itself. With larger noise all poses count, and a robust loss bounds those
    that hold wrong readings (graduated non-convexity: Blake and Zisserman, "Visual Reconstruction",
    1987).

    Args:
        found: the cameras.
        wands: the readings.
        factor: the noise to begin with, over that which the cameras leave.

    Returns:
        The cameras, adjusted again as ``_adjust`` does; None where that fails.
    """
    models = found.models
    noise = found.noise()
    steps = int(np.ceil(np.log2(factor)))
    try:
        for sigma in np.maximum(noise * np.geomspace(factor, 1.0, steps + 1), SIGMA_FLOOR_PX):
            sets = [
                start_poses(models, one, np.full(one.readings_px.shape, sigma)).poses
                for one in wands
            ]
            prior = None
            if any(model.distortion is not None for model in models):
                prior = lens_offset_prior(models, sets)
            models = approximate_solution(
                models, sets, prior=prior, free_datum=True, loss="robust"
            ).models
    except (LumilineError, np.linalg.LinAlgError):
        return None
    return _adjust(models, wands)


def _lens_prior(models: Sequence[SensorModel]) -> SensorPrior:
    """Return the prior of principal distances that are alike and points near the middle."""
    distance = float(np.exp(np.mean([np.log(one.principal_distance_px) for one in models])))
    means, information = [], []
    for model in models:
        means.append(
            replace(
                model, principal_distance_px=distance, principal_point_px=0.5 * (model.pixels - 1.0)
            )
        )
        diagonal = np.zeros(model.parameter_count)
        diagonal[:2] = (DISTANCE_SIGMA * distance) ** -2.0, (POINT_SIGMA * model.pixels) ** -2.0
        information.append(diagonal)
    return SensorPrior(tuple(means), np.diag(np.concatenate(information)))


def _different(models: Sequence[SensorModel], others: Sequence[SensorModel]) -> bool:
    """Return whether inner parameters differ by more than a few per cent."""
    return any(
        abs(one.principal_distance_px / other.principal_distance_px - 1.0) > DIFFERENCE
        or abs(one.principal_point_px - other.principal_point_px)
        > DIFFERENCE * other.principal_distance_px
        for one, other in zip(models, others, strict=True)
    )


def readings_noise(models: Sequence[SensorModel], recordings: Sequence[Recording]) -> float:
    """Return a robust estimate of the noise that cameras leave in readings of wands [px].

    Args:
        models: S cameras.
        recordings: of wands; others are not used.

    Raises:
        TooFewPoints: no pose can be placed.
    """
    wands = [one for one in recordings if isinstance(one.target, Wand)]
    return _Adjusted.of(tuple(models), wands).noise()


def mirrored(models: Sequence[SensorModel]) -> tuple[SensorModel, ...]:
    """Return the mirror image of cameras, which fits readings as well.

    Args:
        models: S cameras; the world is reflected in its plane x = 0.
    """
    images = []
    for model in models:
        right, _, forward = model.rotation * [-1.0, 1.0, 1.0]
        rotation = np.stack([right, np.cross(forward, right), forward])
        vector = vector3(Rotation.from_matrix(rotation).as_rotvec())
        images.append(replace(model, rotation_vector_rad=vector))
    return tuple(images)


def handedness(models: Sequence[SensorModel], pixel_directions: Array) -> float:
    """Return whether cameras or their mirror image agree with the directions of their pixels.

    The signed angles between slits change their sign in the mirror; each pair counts by
    ``[x_i, x_j, z]``, the volume spanned by the pixels' directions and the mean optical axis.

    Args:
        models: S cameras.
        pixel_directions: directions in which readings grow, seen along the optical axes: the
            components to the right and downwards, shape (S, 2).

    Returns:
        The correlation of the volumes, 1: the same; -1: the mirror image; near 0: the description
        does not tell, or is of another device.
    """
    axes = np.array([model.rotation[0] for model in models])
    forward = np.mean([model.rotation[2] for model in models], axis=0)
    found = np.einsum("k,ijk->ij", forward, np.cross(axes[:, None], axes))
    x, y = pixel_directions.T
    described = np.outer(x, y) - np.outer(y, x)
    size = np.linalg.norm(found) * np.linalg.norm(described)
    return float((found * described).sum() / size) if size > 0.0 else 0.0


def direction_vectors(angles_deg: Sequence[float]) -> Array:
    """Return the directions of described pixels, (S, 2), for ``handedness``.

    Args:
        angles_deg: directions in which readings grow, clockwise from the right, seen from the
            device towards the scene, shape (S,) [degrees].
    """
    angles = np.deg2rad(np.asarray(angles_deg, dtype=np.float64))
    return np.stack([np.cos(angles), np.sin(angles)], axis=1)


def pixel_directions(models: Sequence[SensorModel]) -> Array:
    """Return the directions in which readings grow, (S, 2), for ``handedness``.

    Args:
        models: S cameras, an initial calibration or nominal ones.
    """
    frame = device_rotation(models)
    return np.array([(frame @ model.rotation[0])[:2] for model in models])


def settle_handedness(
    models: Sequence[SensorModel], directions: Array | None
) -> tuple[tuple[SensorModel, ...], str]:
    """Return cameras or their mirror image, whichever agrees with a description, and a warning.

    Args:
        models: S cameras in their own frame.
        directions: described directions of the pixels, (S, 2), see ``handedness``; None: unknown.

    Returns:
        The cameras, and a warning where the description does not settle it, else "".
    """
    if directions is None:
        return tuple(models), (
            "The mirror image of these cameras fits the readings as well, and nothing says which "
            "of them is right: give the directions of the sensors' pixels, or initial cameras."
        )
    agreement = handedness(models, directions)
    handedness_warning = ""
    if abs(agreement) < HANDEDNESS_LIMIT:
        handedness_warning = (
            "The described directions of the pixels do not settle which of two mirror images is "
            f"right (correlation {agreement:.2f}, {HANDEDNESS_LIMIT} is wanted): check their "
            "order, their signs, and that not all slits are parallel."
        )
    return (
        tuple(models) if agreement >= 0.0 else _device_frame(mirrored(models))
    ), handedness_warning


def with_terms(
    models: Sequence[SensorModel], recordings: Sequence[Recording], terms: Sequence[Term]
) -> tuple[SensorModel, ...]:
    """Return cameras with distortion terms, each looking at the middle of the markers.

    The terms begin at 0 and are adjusted robustly to the readings of wands, where that succeeds.

    Args:
        models: S cameras without distortion.
        recordings: the readings, whose markers' middle defines where v is 0.
        terms: powers of the field angles.
    """
    cameras = CameraStack.of(models)
    markers = [triangulate(cameras, one.readings_px).reshape(-1, 3) for one in recordings]
    middle = np.nanmedian(np.concatenate(markers), axis=0)
    coefficients = (0.0,) * len(terms)
    start = tuple(
        replace(
            model,
            distortion=FieldDistortion(
                tuple(terms), coefficients, offset_y_mm=-float(model.rotation[1] @ middle)
            ),
        )
        for model in models
    )
    found = _adjust(start, [one for one in recordings if isinstance(one.target, Wand)])
    return start if found is None else _device_frame(found.models)


def device_rotation(models: Sequence[SensorModel]) -> Array:
    """Return the rotation of the world to the device's frame, shape (3, 3).

    Its z is the mean optical axis, its x the first sensor's pixels, perpendicular to z.

    Args:
        models: S cameras.
    """
    forward = np.mean([model.rotation[2] for model in models], axis=0)
    forward /= np.linalg.norm(forward)
    right = models[0].rotation[0] - (models[0].rotation[0] @ forward) * forward
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(forward, right), forward])


def _device_frame(models: Sequence[SensorModel]) -> tuple[SensorModel, ...]:
    # A lens is anywhere along its slit: the point nearest to all slits is the origin.
    rows = np.concatenate([model.rotation[[0, 2]] for model in models])
    right = np.concatenate([[-model.offset_x_mm, -model.offset_z_mm] for model in models])
    origin = np.linalg.lstsq(rows, right, rcond=None)[0]
    rotation = device_rotation(models)
    return tuple(transform_world(model, rotation, -rotation @ origin) for model in models)
