"""One wrong reading of a tool, or a mirrored tool: what becomes of its pose, beside theory."""

from collections import Counter
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import stats
from scipy.spatial.transform import Rotation

from compute.measurement.measurement_model import MeasurementModel
from compute.pose.estimation.pose_fit import PoseFit, fit_pose
from compute.pose.rigid_body import RigidBody
from compute.pose.settings import PoseFitSettings
from compute.transform import rotation_vector
from validation.reliability.ring import jacobian, project, ring

Array = NDArray[np.float64]

SIGMA_PX: Final = 0.05
SENSORS: Final = 4
EXTENT_MM: Final = 150.0
MARKERS_MM: Final = np.array(
    [[0.0, 0.0, 0.0], [60.0, 10.0, 0.0], [-15.0, 70.0, 20.0], [25.0, -20.0, 55.0]]
)
MAX_NEES: Final = 30.0
_MIRROR: Final = np.array([-1.0, 1.0, 1.0])


@dataclass(frozen=True)
class PoseOutcomes:
    """What became of the poses of one kind.

    Args:
        statuses: how many fits ended how.
        detected_theory: share that the chi-square test of all readings finds, by theory.
        detected: share that is INVALID, or from which a reading was excluded.
        excluded_right: share of which the wrong reading was excluded.
        excluded_wrong: share of which another one was.
        misled: share that is OK and off by a normalised error squared above MAX_NEES.
        nees: mean normalised error squared of those that are OK; None: there is none.
    """

    statuses: Counter[str]
    detected_theory: float
    detected: float
    excluded_right: float
    excluded_wrong: float
    misled: float
    nees: float | None


def run(
    readings: int,
    size: float,
    trials: int,
    rng: np.random.Generator,
    *,
    mirrored: bool = False,
    settings: PoseFitSettings | None = None,
) -> PoseOutcomes:
    """Fit poses to some of a tool's readings, all four markers seen, one of them wrong.

    Args:
        readings: number of readings.
        size: error of one of them, in standard deviations.
        trials: number of poses.
        rng: of poses, readings, noise and errors.
        mirrored: whether the true tool is the mirror image of the one that is assumed.
        settings: of the fit; None: as by default.
    """
    matrices, models = ring(SENSORS)
    model = MeasurementModel.of(models)
    tool = RigidBody("tool", MARKERS_MM, None, (0.0, 0.0, 150.0))
    markers = MARKERS_MM * _MIRROR if mirrored else MARKERS_MM
    statuses: Counter[str] = Counter()
    theory, squares, right, wrong, misled = [], [], 0, 0, 0
    for _ in range(trials):
        rotation = Rotation.random(random_state=rng).as_matrix()
        origin = EXTENT_MM * rng.uniform(-1.0, 1.0, 3)
        mask = _mask(readings, rng)
        lying = rng.choice(np.flatnonzero(mask))
        positions = markers @ rotation.T + origin
        observed = project(matrices, positions) + SIGMA_PX * rng.standard_normal(mask.shape)
        observed.flat[lying] += size * SIGMA_PX * rng.choice([-1.0, 1.0])
        sigma = np.full(mask.shape, SIGMA_PX)
        found = fit_pose(model, tool, np.where(mask, observed, np.nan), sigma, settings=settings)
        statuses[found.status.value] += 1
        theory.append(_detection(matrices, positions - origin, positions, mask, int(lying), size))
        if found.excluded:
            hit = found.excluded[0][0] * SENSORS + found.excluded[0][1] == lying and size > 0.0
            right, wrong = right + hit, wrong + (not hit)
        if found.status.value == "OK":
            squares.append(_nees(found, rotation, origin))
            misled += squares[-1] > MAX_NEES
    refused = statuses["INVALID"]
    return PoseOutcomes(
        statuses,
        float(np.mean(theory)),
        (refused + right + wrong) / trials,
        right / trials,
        wrong / trials,
        misled / trials,
        float(np.mean(squares)) if squares else None,
    )


def _mask(readings: int, rng: np.random.Generator) -> NDArray[np.bool_]:
    """Return which readings there are, one of each marker at least, shape (M, S)."""
    shape = (len(MARKERS_MM), SENSORS)
    while True:
        mask = np.zeros(shape[0] * shape[1], dtype=np.bool_)
        mask[rng.permutation(mask.size)[:readings]] = True
        if mask.reshape(shape).any(axis=1).all():
            return mask.reshape(shape)


def _detection(
    matrices: Array,
    arms: Array,
    positions: Array,
    mask: NDArray[np.bool_],
    lying: int,
    size: float,
) -> float:
    """Return the probability that the chi-square test of all readings finds the error."""
    by_place = jacobian(matrices, positions)
    # A small rotation w moves a marker by w x arm: d reading / d w = arm x (d reading / d place).
    by_rotation = np.cross(arms[:, None], by_place)
    design = np.concatenate([by_rotation, by_place], axis=-1)[mask]
    dof = len(design) - 6
    limit = stats.chi2.isf(PoseFitSettings().false_rejection_probability, dof)
    if size == 0.0:
        return float(stats.chi2.sf(limit, dof))
    basis = np.linalg.qr(design / np.linalg.norm(design, axis=0))[0]
    own = int(np.flatnonzero(np.flatnonzero(mask) == lying)[0])
    redundancy = max(1.0 - float(basis[own] @ basis[own]), 0.0)
    return float(stats.ncx2.sf(limit, dof, size**2 * redundancy + 1e-12))


def _nees(found: PoseFit, rotation: Array, origin: Array) -> float:
    assert found.rotation is not None
    assert found.translation_mm is not None
    assert found.covariance is not None
    turn = rotation_vector(found.rotation @ rotation.T)
    error = np.concatenate([turn, found.translation_mm - origin])
    return float(error @ np.linalg.solve(found.covariance, error))
