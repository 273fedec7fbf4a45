"""Surface registration: iterative closest points (ICP) refines a registration by surface points."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.errors import (
    HighError,
    InvalidParameter,
    NoConvergence,
    TooFewPoints,
    UndeterminedParameters,
)
from compute.pose.registration.absolute_orientation import fit_isotropic_similarity
from compute.pose.registration.surface import Surface
from compute.robust_statistics import MAD_OF_NORMAL
from compute.transform import (
    Transform,
    cross_matrix,
    finite_points,
    nearest_rotation,
    rotation_matrix,
    rotation_vector,
)

Array = NDArray[np.float64]

_HALVINGS: Final = 10
_MIN_RESTART_POINTS: Final = 100
"""Smallest size of the subset of points that other starts are tried with."""
_MIN_RELATIVE_GAIN: Final = 1e-6
"""Relative decrease of the sum of squares below which the iteration has converged: about 1 % of the
result's standard deviation."""


@dataclass(frozen=True)
class IcpSettings:
    """Settings of a surface registration.

    Args:
        min_points: smallest number of points; only a curved surface constrains six unknowns.
        trim: fraction of the points, the farthest, that each step leaves out, below a half.
        max_steps: largest number of steps, halved ones included.
        min_stiffness_ratio: smallest stiffness of the most weakly constrained motion over that of
            the most strongly constrained: the square of the ratio of their standard deviations.
        max_rms_mm: largest RMS distance of the kept points [mm].
        start_turn_rad: largest rotation error of the start [rad]: the registration is repeated
            from starts rotated by this to either side about three axes, in search of another
            result; 0: it is not.
        start_shift_mm: likewise shifted along three axes [mm].
    """

    min_points: int = 12
    trim: float = 0.1
    max_steps: int = 200
    min_stiffness_ratio: float = 1e-3
    max_rms_mm: float = 5.0
    start_turn_rad: float = float(np.radians(5.0))
    start_shift_mm: float = 5.0

    def __post_init__(self) -> None:
        if not 0.0 <= self.trim < 0.5:
            raise InvalidParameter(f"trim is {self.trim}; it must be from 0 to below 0.5")


@dataclass(frozen=True, eq=False)
class IcpRegistration:
    """A registration by a surface.

    Args:
        transform: T_surface_points, with the covariance from the distances of the kept points
            (independent, along the normals; a systematic gap such as skin adds to it).
        distance_mm: distance of each point from the surface, shape (N,) [mm].
        kept: which points were used, shape (N,).
        rms_mm: RMS distance of those [mm].
        steps: number of steps.
        stiffness_ratio: stiffness of the most weakly constrained motion over that of the most
            strongly constrained, from 0 to 1; rotations count by the RMS distance of the points
            from their centroid.
        weakest_motion: the most weakly constrained motion in words.
        other: the best different result from another start; None: all starts agree, or were not
            tried.
        other_rms_mm: its RMS distance [mm].
    """

    transform: Transform
    distance_mm: Array
    kept: NDArray[np.bool_]
    rms_mm: float
    steps: int
    stiffness_ratio: float
    weakest_motion: str
    other: Transform | None
    other_rms_mm: float | None


@dataclass(frozen=True, eq=False)
class _Alignment:
    rotation: Array
    translation: Array
    moved: Array
    closest: Array
    normals: Array
    along: Array
    off: Array
    kept: NDArray[np.bool_]
    misfit: float
    rms: float
    steps: int = 0


def register_surface(
    points_mm: Array,
    surface: Surface,
    start: Transform,
    settings: IcpSettings | None = None,
    tell: Callable[[], None] = lambda: None,
) -> IcpRegistration:
    """Refine a registration so that points lie on a surface.

    Each step moves the points towards their closest points on the surface: along the normals
    where these are known (Y. Chen, G. Medioni, doi:10.1016/0262-8856(92)90066-C), else in all
    directions (P. J. Besl, N. D. McKay, doi:10.1109/34.121791), without the farthest points
    (D. Chetverikov and others, doi:10.1016/j.imavis.2005.05.007).

    Args:
        points_mm: shape (N, 3) [mm].
        surface: a PointCloud or a TriangleMesh.
        start: T_surface_points, such as that of paired points; the result is the minimum near it.
        settings: number of points and steps, trimming, limits.
        tell: called before every search of closest points; an exception that it raises ends the
            registration.

    Raises:
        TooFewPoints: fewer than ``min_points``.
        UndeterminedParameters: the points can slide on the surface, such as a sphere or a plane.
        HighError: the points do not lie on the surface.
        NoConvergence: the iteration did not converge.
        InvalidParameter, NonFiniteValue: the points are of a wrong shape, or not finite.
    """
    criteria = settings or IcpSettings()
    points = finite_points(points_mm, "points_mm")
    if len(points) < criteria.min_points:
        raise TooFewPoints(
            f"{len(points)} points on the surface; at least {criteria.min_points} are needed",
            points=len(points),
            needed=criteria.min_points,
        )
    search = _Icp(surface, tell, criteria)
    alignment = search.iterate(points, start.rotation, start.translation_mm)
    centre = alignment.moved[alignment.kept].mean(axis=0)
    length, normal = _stiffness(alignment, centre)
    values, axes = np.linalg.eigh(normal)
    stiffness_ratio = float(max(values[0], 0.0) / values[-1])
    weakest_motion = _describe_motion(axes[:, 0], centre)
    if stiffness_ratio < criteria.min_stiffness_ratio:
        raise UndeterminedParameters(
            f"the surface does not hold {weakest_motion}: its stiffness is {stiffness_ratio:.1e} "
            f"of the best held motion's; at least {criteria.min_stiffness_ratio:.0e} is needed. "
            "Take points where the surface bends another way",
            stiffness_ratio=stiffness_ratio,
            needed=criteria.min_stiffness_ratio,
            motion=weakest_motion,
        )
    if alignment.rms > criteria.max_rms_mm:
        raise HighError(
            f"the points are {alignment.rms:.3g} mm RMS off the surface; they must be within "
            f"{criteria.max_rms_mm:g} mm: the start is too far off, or they are of another surface",
            rms_mm=alignment.rms,
            max_mm=criteria.max_rms_mm,
        )
    other = _alternative_minimum(search, points, start, alignment, length)
    return IcpRegistration(
        Transform(
            alignment.rotation,
            alignment.translation,
            _covariance(alignment, normal, centre, length),
        ),
        alignment.off,
        alignment.kept,
        alignment.rms,
        alignment.steps,
        stiffness_ratio,
        weakest_motion,
        None if other is None else Transform(other.rotation, other.translation),
        None if other is None else other.rms,
    )


@dataclass(frozen=True, eq=False)
class _Icp:
    surface: Surface
    tell: Callable[[], None]
    settings: IcpSettings

    def iterate(self, points: Array, rotation: Array, translation: Array) -> _Alignment:
        """Return where steps end that bring the points nearer, whole or halved.

        Raises:
            NoConvergence: they do not end within ``settings.max_steps``.
        """
        radius = float(np.sqrt(((points - points.mean(axis=0)) ** 2).sum(axis=1).mean()))
        here = self.align(points, rotation, translation)
        steps = 0
        while steps < self.settings.max_steps:
            step, centre = self.step(here)
            for _ in range(_HALVINGS):
                steps += 1
                increment = rotation_matrix(step[:3])
                there = self.align(
                    points,
                    nearest_rotation(increment @ here.rotation),
                    increment @ (here.translation - centre) + centre + step[3:],
                )
                if there.misfit < here.misfit:
                    break
                step = 0.5 * step
            gained = here.misfit - there.misfit
            if gained > 0.0:
                here = there
            size = float(radius * np.linalg.norm(step[:3]) + np.linalg.norm(step[3:]))
            if gained <= _MIN_RELATIVE_GAIN * here.misfit or size < 1e-9 * radius:
                return replace(here, steps=steps)
        raise NoConvergence(
            f"the surface registration did not end in {self.settings.max_steps} steps; the last "
            f"moved the points by {size:.2g} mm, and they are {here.rms:.3g} mm RMS off the surface"
        )

    def align(self, points: Array, rotation: Array, translation: Array) -> _Alignment:
        """Return how the points lie beside the surface after a motion."""
        moved = points @ rotation.T + translation
        self.tell()
        closest, normals = self.surface.nearest(moved)
        off = moved - closest
        along = (off * normals).sum(axis=1)
        distance = np.linalg.norm(off, axis=1)
        inliers = np.zeros(len(points), bool)
        keep = max(int(np.ceil((1.0 - self.settings.trim) * len(points))), 6)
        inliers[np.argsort(distance, kind="stable")[:keep]] = True
        counted = along if self.surface.exact_normals else distance
        misfit = float((counted[inliers] ** 2).sum())
        rms = float(np.sqrt((distance[inliers] ** 2).mean()))
        return _Alignment(
            rotation, translation, moved, closest, normals, along, distance, inliers, misfit, rms
        )

    def step(self, here: _Alignment) -> tuple[Array, Array]:
        """Return the motion (rotation, shift) of the kept points about their centre, and this."""
        moved = here.moved[here.kept]
        centre = moved.mean(axis=0)
        if not self.surface.exact_normals:
            similarity = fit_isotropic_similarity(
                moved, here.closest[here.kept], np.ones(len(moved))
            )
            rotation = rotation_vector(similarity.rotation)
            return np.concatenate([rotation, similarity.apply(centre) - centre]), centre
        normals = here.normals[here.kept]
        jacobian = np.concatenate([np.cross(moved - centre, normals), normals], axis=1)
        # Motions that the surface does not constrain are left unchanged (and reported afterwards).
        return -np.linalg.lstsq(jacobian, here.along[here.kept], rcond=1e-6)[0], centre


def _stiffness(alignment: _Alignment, centre: Array) -> tuple[float, Array]:
    """Return the points' RMS distance from their centroid, and the normal matrix in units of it."""
    inliers = alignment.kept
    centred = alignment.moved[inliers] - centre
    length = float(np.sqrt((centred**2).sum(axis=1).mean()))
    normals = alignment.normals[inliers]
    jacobian = np.concatenate([np.cross(centred, normals) / length, normals], axis=1)
    return length, jacobian.T @ jacobian


def _covariance(alignment: _Alignment, normal: Array, centre: Array, length: float) -> Array:
    """Return the covariance of rotation and translation."""
    # Trimming removes the tails: the standard deviation comes from the median.
    sigma = float(np.median(alignment.off)) / MAD_OF_NORMAL
    sigma *= float(np.sqrt(len(alignment.off) / (len(alignment.off) - 6.0)))
    scale = np.diag([1.0 / length] * 3 + [1.0] * 3)
    centred = sigma**2 * scale @ np.linalg.inv(normal) @ scale
    back = np.eye(6)
    # x = exp([w]x) (x - centre) + centre + d: seen from the origin t moves by -w x (centre - t).
    back[3:, :3] = cross_matrix(centre - alignment.translation)
    covariance: Array = back @ centred @ back.T
    return covariance


def _describe_motion(motion: Array, centre: Array) -> str:
    angle, shift = np.linalg.norm(motion[:3]), np.linalg.norm(motion[3:])
    if angle > shift:
        x, y, z = motion[:3] / angle
        near = ", ".join(f"{one:.1f}" for one in centre)
        return f"a rotation about ({x:.2f}, {y:.2f}, {z:.2f}) near ({near}) mm"
    x, y, z = motion[3:] / shift
    return f"a shift along ({x:.2f}, {y:.2f}, {z:.2f})"


def _alternative_minimum(
    search: _Icp, points: Array, start: Transform, alignment: _Alignment, length: float
) -> _Alignment | None:
    """Return the best result from other starts that is another one, and about as good."""
    # A subset of the points finds the minimum of each start; all points refine it.
    some = points[:: max(1, len(points) // _MIN_RESTART_POINTS)]
    here = alignment
    if len(some) < len(points):
        try:
            here = search.iterate(some, alignment.rotation, alignment.translation)
        except NoConvergence:
            some = points

    def is_other(tried: _Alignment, here: _Alignment) -> bool:
        apart = np.sqrt(((tried.moved - here.moved) ** 2).sum(axis=1).mean())
        return bool(apart > max(here.rms, 1e-3 * length) and tried.rms <= 1.5 * here.rms)

    alternatives: list[_Alignment] = []
    for rotation, translation in _other_starts(points, start, search.settings):
        try:
            tried = search.iterate(some, rotation, translation)
            if is_other(tried, here) and here is not alignment:
                tried = search.iterate(points, tried.rotation, tried.translation)
        except NoConvergence:
            continue
        if len(tried.moved) == len(points) and is_other(tried, alignment):
            alternatives.append(tried)
    return min(alternatives, key=lambda one: one.rms, default=None)


def _other_starts(
    points: Array, start: Transform, settings: IcpSettings
) -> Iterator[tuple[Array, Array]]:
    """Yield rotation and translation of the start, rotated and shifted along three axes."""
    centre = start.apply(points.mean(axis=0))
    for axis in np.concatenate([np.eye(3), -np.eye(3)]):
        if settings.start_turn_rad > 0.0:
            tilt = rotation_matrix(settings.start_turn_rad * axis)
            yield tilt @ start.rotation, tilt @ (start.translation_mm - centre) + centre
        if settings.start_shift_mm > 0.0:
            yield start.rotation, start.translation_mm + settings.start_shift_mm * axis
