"""Pivot calibration: a tool's tip, from poses turned about a fixed point."""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from compute.calibration.robust import biweight
from compute.camera.rotation import rotation_matrix
from compute.errors import HighError, NoConvergence, TooFewPoses, TooLittleRotation
from compute.pose.orientations import Orientations
from compute.pose.pose_input import checked_poses
from compute.pose.transform import cross_matrix

Array = NDArray[np.float64]

UNKNOWNS: Final = 6
_OUTLYING: Final = float(np.sqrt(chi2.isf(1e-4, 3)))
"""Distance, in deviations in space, beyond which a pose is left out: one good one in 10 000."""
_MEDIAN: Final = float(np.sqrt(chi2.median(3)))
_TRIPLES: Final = 120
"""Of poses of which 40 % are wrong one triple in five is right: never none of so many."""
_STEPS: Final = 50


@dataclass(frozen=True)
class PivotSettings:
    """What a pivot calibration asks of its poses.

    Args:
        least_poses: fewest poses that have to agree.
        least_swing_rad: least RMS angle by which each direction of the tool has to swing [rad].
            The tip's deviation in a direction is that of a pose over the root of their number,
            over the sine of this angle.
        most_rms_mm: largest RMS distance of the tip from the fixed point [mm].
        most_outlying: largest share of poses that may be left out, below a half.
    """

    least_poses: int = 10
    least_swing_rad: float = float(np.radians(5.0))
    most_rms_mm: float = 1.0
    most_outlying: float = 0.4


@dataclass(frozen=True, eq=False)
class PivotResult:
    """A tip, and how well it is known.

    Args:
        tip_mm: in the tool's coordinates, shape (3,) [mm].
        tip_covariance_mm2: shape (3, 3) [mm^2]; where poses scatter more than their covariances
            say, by their scatter.
        pivot_mm: the fixed point in the world, shape (3,) [mm].
        pivot_covariance_mm2: shape (3, 3) [mm^2].
        distance_mm: of the tip from the fixed point at each pose, shape (N,) [mm].
        rms_mm: root of the mean square of those used [mm].
        residual_sigma: root of chi2 per degree of freedom of those used, about 1 where the
            covariances are right; None: there were none.
        outlying: indices of the poses that do not fit the others and were left out.
        orientations: how far the tool was turned, of the poses used.
    """

    tip_mm: Array
    tip_covariance_mm2: Array
    pivot_mm: Array
    pivot_covariance_mm2: Array
    distance_mm: Array
    rms_mm: float
    residual_sigma: float | None
    outlying: tuple[int, ...]
    orientations: Orientations


def pivot_calibration(
    rotations: Array,
    translations_mm: Array,
    covariances: Array | None = None,
    settings: PivotSettings | None = None,
) -> PivotResult:
    """Return the point of a tool that stayed where it was while the tool was turned.

    Solves ``R_i tip + t_i = pivot`` for tip and pivot: linear from triples of poses, the start
    being that which fits most poses; from there weighted by the covariance of ``R_i tip + t_i``,
    with the orientations adjusted within theirs (Z. Yaniv, doi:10.1117/12.2081348, compares the
    unweighted ways), and with Tukey's loss, until what does not fit is named and left out.

    Args:
        rotations: R_world_tool, shape (N, 3, 3).
        translations_mm: shape (N, 3) [mm].
        covariances: of turn [rad] and translation [mm] as in ToolPose, shape (N, 6, 6); None: not
            known: the scatter tells, and all poses count the same.
        settings: what is asked of the poses.

    Raises:
        TooFewPoses: there are, or agree, fewer than asked for.
        TooLittleRotation: a direction of the tool swung less than asked for; the tip is not
            determined along it.
        HighError: the tip did not stay at one point.
        InvalidParameter, NonFiniteValue: the arrays are not what they should be.
        NoConvergence: the adjustment did not end.
    """
    wanted = settings or PivotSettings()
    turned, moved, known = checked_poses(rotations, translations_mm, covariances)
    count = len(moved)
    if count < wanted.least_poses:
        raise TooFewPoses(
            f"{count} poses; a pivot calibration needs at least {wanted.least_poses}, with the "
            "tool turned about its tip to and fro and to the sides",
            poses=count,
            needed=wanted.least_poses,
        )
    _check_rotation(Orientations.of(turned), wanted)
    unknowns = _robust(turned, moved, known, _start(turned, moved))
    used = _fitting(turned, moved, known, unknowns)
    for _ in range(3):
        _check_used(used, wanted)
        some = None if known is None else known[used]
        unknowns = _adjusted(turned[used], moved[used], some, unknowns)
        again = _fitting(turned, moved, known, unknowns, used)
        if (again == used).all():
            break
        used = again
    _check_used(used, wanted)
    orientations = Orientations.of(turned[used])
    _check_rotation(orientations, wanted)
    off = _off(turned, moved, unknowns)
    distance = np.linalg.norm(off, axis=1)
    rms = float(np.sqrt((distance[used] ** 2).mean()))
    if rms > wanted.most_rms_mm:
        raise HighError(
            f"the tip is {rms:.3g} mm RMS off the fixed point over {int(used.sum())} poses; it "
            f"must be within {wanted.most_rms_mm:g} mm: hold it in a pit, and check that the "
            "markers are firm on the tool",
            rms_mm=rms,
            most_mm=wanted.most_rms_mm,
        )
    normal, misfit = _normal(turned[used], moved[used], None if known is None else known[used],
                             unknowns)  # fmt: skip
    factor = misfit / (3 * used.sum() - UNKNOWNS)
    covariance = np.linalg.inv(normal) * (factor if known is None else max(1.0, factor))
    return PivotResult(
        unknowns[:3],
        covariance[:3, :3],
        unknowns[3:],
        covariance[3:, 3:],
        distance,
        rms,
        None if known is None else float(np.sqrt(factor)),
        tuple(np.flatnonzero(~used).tolist()),
        orientations,
    )


def _check_rotation(orientations: Orientations, wanted: PivotSettings) -> None:
    least = float(orientations.swing_rad[0])
    if least >= wanted.least_swing_rad:
        return
    x, y, z = orientations.axes[0]
    raise TooLittleRotation(
        f"{orientations.in_words()}. Each must swing by at least "
        f"{np.degrees(wanted.least_swing_rad):.1f} deg RMS: the tip is not determined along "
        f"({x:.2f}, {y:.2f}, {z:.2f}); turn the tool about other axes too",
        swing_deg=np.degrees(orientations.swing_rad).tolist(),
        range_deg=float(np.degrees(orientations.range_rad)),
        least_deg=float(np.degrees(wanted.least_swing_rad)),
        undetermined=[float(x), float(y), float(z)],
    )


def _check_used(used: NDArray[np.bool_], wanted: PivotSettings) -> None:
    left = int(used.sum())
    if left >= max(wanted.least_poses, (1.0 - wanted.most_outlying) * len(used)):
        return
    first = np.flatnonzero(~used)[:10].tolist()
    raise HighError(
        f"{len(used) - left} of {len(used)} poses do not fit the others (the first: {first}); "
        f"at least {wanted.least_poses} poses and {1.0 - wanted.most_outlying:.0%} of them must "
        "agree: the tip moved, or there was none",
        outlying=len(used) - left,
        poses=len(used),
    )


def _start(turned: Array, moved: Array) -> Array:
    """Return tip and pivot (6,) that bring most poses together, each try from three of them."""
    count = len(moved)
    # The same poses give the same bits.
    chance = np.random.default_rng(0)
    picks = np.argpartition(chance.random((_TRIPLES, count)), 3, axis=1)[:, :3]
    design = np.concatenate(
        [turned[picks], np.broadcast_to(-np.eye(3), (_TRIPLES, 3, 3, 3))], axis=-1
    ).reshape(_TRIPLES, 9, 6)
    # Minimum-norm: three poses of nearly the same orientation make no start, and score badly.
    tries = np.einsum(
        "kij,kj->ki", np.linalg.pinv(design, rcond=1e-4), -moved[picks].reshape(_TRIPLES, 9)
    )
    every = np.concatenate([turned, np.broadcast_to(-np.eye(3), turned.shape)], axis=-1)
    whole = np.linalg.lstsq(every.reshape(-1, 6), -moved.reshape(-1), rcond=None)[0]
    tries = np.concatenate([whole[None], tries])
    scores = [float(np.median(np.linalg.norm(_off(turned, moved, one), axis=1))) for one in tries]
    return np.asarray(tries[int(np.argmin(scores))])


def _off(turned: Array, moved: Array, unknowns: Array) -> Array:
    """Return ``R_i tip + t_i - pivot``, shape (N, 3) [mm]."""
    off: Array = turned @ unknowns[:3] + moved - unknowns[3:]
    return off


def _information(turned: Array, known: Array | None, unknowns: Array) -> tuple[Array, Array]:
    """Return the slopes of what is off to the pose (N, 3, 6) and its information (N, 3, 3)."""
    slopes = np.empty((len(turned), 3, 6))
    slopes[..., :3] = -cross_matrix(turned @ unknowns[:3])
    slopes[..., 3:] = np.eye(3)
    if known is None:
        return slopes, np.broadcast_to(np.eye(3), (len(turned), 3, 3))
    information = np.linalg.inv(slopes @ known @ slopes.swapaxes(1, 2))
    return slopes, np.asarray(information, np.float64)


def _sizes(turned: Array, moved: Array, known: Array | None, unknowns: Array) -> Array:
    """Return how far each pose is off, in its deviations, or in mm where none are known, (N,)."""
    off = _off(turned, moved, unknowns)
    _, information = _information(turned, known, unknowns)
    sizes: Array = np.sqrt(np.einsum("ni,nij,nj->n", off, information, off))
    return sizes


def _scale(sizes: Array, known: Array | None) -> float:
    found = float(np.median(sizes)) / _MEDIAN
    return max(found, 1.0) if known is not None else max(found, 1e-9)


def _fitting(
    turned: Array,
    moved: Array,
    known: Array | None,
    unknowns: Array,
    among: NDArray[np.bool_] | None = None,
) -> NDArray[np.bool_]:
    """Return which poses fit, by the scatter of those ``among`` them, shape (N,)."""
    sizes = _sizes(turned, moved, known, unknowns)
    return sizes <= _OUTLYING * _scale(sizes if among is None else sizes[among], known)


def _robust(turned: Array, moved: Array, known: Array | None, unknowns: Array) -> Array:
    """Return tip and pivot under Tukey's loss, the scale falling with the scatter."""
    for _ in range(20):
        sizes = _sizes(turned, moved, known, unknowns)
        # The loss counts deviations of a number; the median of three together is larger.
        weight = biweight(sizes / _scale(sizes, known) / np.sqrt(3.0) * 1.5)
        step = _step(turned, moved, known, unknowns, weight)
        unknowns = unknowns + step
        if np.abs(step).max() < 1e-7:
            break
    return unknowns


def _adjusted(turned: Array, moved: Array, known: Array | None, unknowns: Array) -> Array:
    """Return tip and pivot by weighted least squares."""
    weight = np.ones(len(moved))
    for _ in range(_STEPS):
        step = _step(turned, moved, known, unknowns, weight)
        unknowns = unknowns + step
        if np.abs(step).max() < 1e-9 * (1.0 + np.abs(unknowns).max()):
            return unknowns
    raise NoConvergence(
        f"the pivot calibration did not converge in {_STEPS} steps; the last moved the tip by "
        f"{np.linalg.norm(step[:3]):.2g} mm"
    )


def _step(
    turned: Array, moved: Array, known: Array | None, unknowns: Array, weight: Array
) -> Array:
    off = _off(turned, moved, unknowns)
    slopes, information = _information(turned, known, unknowns)
    pull = np.einsum("nij,nj->ni", information, off)
    right = turned
    if known is not None:
        # The likelihood's slope is that at the adjusted orientations: with the measured ones,
        # their noise would pull the tip towards the tool's origin.
        turn = np.einsum("nij,nkj,nk->ni", known, slopes, pull)[:, :3]
        right = rotation_matrix(-turn) @ turned
    design = np.concatenate([right, np.broadcast_to(-np.eye(3), right.shape)], axis=-1)
    normal = np.einsum("n,nia,nij,njb->ab", weight, design, information, design, optimize=True)
    gradient = np.einsum("n,nia,ni->a", weight, design, pull)
    return -np.linalg.solve(normal, gradient)


def _normal(
    turned: Array, moved: Array, known: Array | None, unknowns: Array
) -> tuple[Array, float]:
    """Return the normal matrix (6, 6) and chi2."""
    _, information = _information(turned, known, unknowns)
    design = np.concatenate([turned, np.broadcast_to(-np.eye(3), turned.shape)], axis=-1)
    off = _off(turned, moved, unknowns)
    normal = np.einsum("nia,nij,njb->ab", design, information, design, optimize=True)
    return normal, float(np.einsum("ni,nij,nj->", off, information, off))
