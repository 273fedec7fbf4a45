"""Ghost points: false intersections of planes when several markers are lit at once."""

from collections.abc import Iterator
from dataclasses import dataclass
from math import comb, perm
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.camera.stack import CameraStack
from compute.errors import InvalidParameter
from compute.parameter_checks import require
from compute.planning.coverage import Box
from compute.reconstruction.correspondence.candidates import FALSE_REJECTION
from compute.reconstruction.triangulation import chi2_limit, reconstruct

Array = NDArray[np.float64]

MAX_SENSORS: Final = 6
"""Sensors whose groupings are counted: 203 of six, 877 of seven."""

_PREGATE_FACTOR: Final = 9.0  # times the limit: largest linear misfit that is evaluated exactly
_MAX_DRAWS_FACTOR: Final = 50  # times as many markers as are wanted, to find ones that all see


def intersecting_points(markers: int, sensors: int = 3) -> int:
    """Return the number of points where lines of N markers intersect in the planar case, [2.15].

    Orthographically, along one direction, every reading is a line in the image plane; each of S
    sensors has N parallel ones, in a direction of its own. Two sensors' lines meet in N^2 points,
    so S (S - 1) / 2 pairs make S (S - 1) / 2 N^2. At the N markers themselves all S lines meet:
    each of these is counted S (S - 1) / 2 times and is one point. In general position no other
    three lines meet, so that there are ``C(S, 2) (N^2 - N) + N`` points; with S = 3 that is
    ``3 N^2 - 2 N`` [2.15]: 8 for two markers, 21 for three.

    Args:
        markers: N, at least 1.
        sensors: S, at least 2.

    Raises:
        InvalidParameter: too few of either.
    """
    _check(markers, sensors, least=2)
    return comb(sensors, 2) * (markers**2 - markers) + markers


def candidates(markers: int, sensors: int) -> int:
    """Return the number of combinations of one peak from each sensor, N^S.

    In perspective, three planes of any combination meet in one point: with S = 3 all N^3 are
    points that fit exactly, N^3 - N of them ghosts, of which those outside the working volume
    are recognised. A fourth plane does not pass through that point by itself.

    Args:
        markers: N, at least 1.
        sensors: S, at least 3.

    Raises:
        InvalidParameter: too few of either.
    """
    _check(markers, sensors, least=3)
    return int(markers**sensors)


@dataclass(frozen=True)
class GhostCount:
    """Expected number of wrong combinations that look like markers.

    Args:
        markers: N markers lit at once.
        candidates: combinations in all, N^S.
        expected: mean number of wrong ones that fit within the noise, inside the volume.
        standard_error: of ``expected``, from the Monte Carlo.
    """

    markers: int
    candidates: int
    expected: float
    standard_error: float


@dataclass(frozen=True)
class GhostProbabilities:
    """Probabilities that wrong combinations look like a marker.

    Which sensors' peaks come from the same marker is a partition of the sensors, for example ((0,
    2), (1,), (3,)). Its probability does not depend on how many markers there are, so one Monte
    Carlo serves any number of them.

    Args:
        sensors: S.
        partitions: the partitions of the sensors into two or more groups.
        probability: of each to fit within the noise, inside the volume.
        variance: of each probability, from the Monte Carlo.
        visible_fraction: share of the volume that all sensors see, whence the markers are drawn.
    """

    sensors: int
    partitions: tuple[tuple[tuple[int, ...], ...], ...]
    probability: tuple[float, ...]
    variance: tuple[float, ...]
    visible_fraction: float

    def expected(self, markers: int) -> GhostCount:
        """Return the expected number of ghosts of N markers.

        A partition into k groups stands for N! / (N - k)! combinations.
        """
        count = candidates(markers, self.sensors)
        ways = np.array([float(perm(markers, len(partition))) for partition in self.partitions])
        expected = float(ways @ np.array(self.probability))
        error = float(np.sqrt(ways**2 @ np.array(self.variance)))
        return GhostCount(markers, count, expected, error)


def ghost_probabilities(
    cameras: CameraStack,
    pixels: int,
    box: Box | None,
    sigma_px: Array,
    *,
    drawn_from: Box,
    trials: int = 4000,
    seed: int = 0,
    limit_sigma: float | None = None,
) -> GhostProbabilities:
    """Estimate by Monte Carlo the probabilities that wrong combinations look like a marker.

    Markers are drawn evenly from the part of ``drawn_from`` that all sensors see, and read with
    noise; one peak of each sensor is taken as the partition says; the combination is a ghost
    when ``compute.reconstruction`` finds it a point inside ``box`` with chi2 within the limit.

    Args:
        cameras: S cameras, 3 to 6.
        pixels: pixels of a line.
        box: where a marker may be; None: anywhere in front of the sensors.
        sigma_px: standard deviations of the readings, shape (S,) [px].
        drawn_from: where the markers are.
        trials: combinations tried of each partition.
        seed: of the random numbers.
        limit_sigma: root of the largest chi2 that fits; None: that of the peaks' correspondence,
            beyond which a true combination lies once in a million.

    Raises:
        InvalidParameter: too few or many sensors, no trial, or a volume that is not seen.
    """
    sensors = len(cameras)
    if not 3 <= sensors <= MAX_SENSORS:
        raise InvalidParameter(
            f"there are {sensors} sensors; ghosts are counted for 3 to {MAX_SENSORS}",
            sensors=sensors,
        )
    require(trials >= 1, "be at least 1", trials=trials)
    sigma = np.broadcast_to(np.asarray(sigma_px, dtype=np.float64), (sensors,))
    positive = ((sigma > 0.0) & np.isfinite(sigma)).all()
    require(positive, "be positive", sigma_px=sigma.tolist())
    limit = chi2_limit(sensors - 3, FALSE_REJECTION) if limit_sigma is None else limit_sigma**2
    rng = np.random.default_rng(seed)
    probability, variance, shares = [], [], []
    wrong = tuple(partition for partition in _partitions(sensors) if len(partition) > 1)
    for partition in wrong:
        readings = np.empty((trials, sensors))
        for group in partition:
            markers, share = _markers(cameras, pixels, drawn_from, trials, rng)
            readings[:, group] = cameras.project(markers)[:, group]
            shares.append(share)
        readings += sigma * rng.standard_normal(readings.shape)
        hits = _ghosts(cameras, readings, sigma, box, limit)
        probability.append(hits / trials)
        # With one hit more and one miss more: no hit is not a proof that there are none.
        likely = (hits + 1.0) / (trials + 2.0)
        variance.append(likely * (1.0 - likely) / trials)
    return GhostProbabilities(
        sensors, wrong, tuple(probability), tuple(variance), float(np.mean(shares))
    )


def _markers(
    cameras: CameraStack, pixels: int, box: Box, count: int, rng: np.random.Generator
) -> tuple[Array, float]:
    """Draw markers that all sensors see, shape (count, 3), and the share of draws that they are.

    Raises:
        InvalidParameter: the sensors see too little of the box together.
    """
    accepted: list[Array] = []
    number = drawn = 0
    while number < count:
        if drawn >= _MAX_DRAWS_FACTOR * count:
            raise InvalidParameter(
                f"of {drawn} points in the volume {number} are seen by all sensors; ghosts need "
                "a volume that they see together",
                centre_mm=box.centre_mm,
            )
        points = box.uniform(count, rng)
        reading = cameras.project(points)
        with np.errstate(invalid="ignore"):
            visible = ((reading >= -0.5) & (reading <= pixels - 0.5)).all(axis=1)
        accepted.append(points[visible])
        number += int(visible.sum())
        drawn += count
    return np.concatenate(accepted)[:count], number / drawn


def _ghosts(
    cameras: CameraStack, readings_px: Array, sigma_px: Array, box: Box | None, limit: float
) -> int:
    """Count the combinations that are reconstructed as markers."""
    if len(cameras) > 3:
        # Most wrong combinations miss by far: a linear misfit leaves few to iterate on.
        readings_px = readings_px[
            _misfit(cameras, readings_px, sigma_px) <= _PREGATE_FACTOR * limit
        ]
    if len(readings_px) == 0:
        return 0
    points = reconstruct(cameras, readings_px, sigma_px)
    fits = np.isfinite(points.position_mm[:, 0])
    if len(cameras) > 3:
        with np.errstate(invalid="ignore"):
            fits &= points.chi2 <= limit
    if box is not None:
        fits &= box.contains(points.position_mm)
    return int(fits.sum())


def _misfit(cameras: CameraStack, readings_px: Array, sigma_px: Array) -> Array:
    """Return an approximate chi2 of combinations (T, S), shape (T,); infinite behind a lens."""
    rows = cameras.matrices[:, 0] - readings_px[..., None] * cameras.matrices[:, 1]
    plane, right = rows[..., :3], -rows[..., 3]
    normal = plane.transpose(0, 2, 1) @ plane
    point = np.linalg.solve(normal, np.einsum("tsi,ts->ti", plane, right)[..., None])[..., 0]
    projected, slope = cameras.linearise(point)
    whitened = (readings_px - projected) / sigma_px
    slope = slope / sigma_px[:, None]
    ahead = np.isfinite(whitened).all(axis=1)
    chi2 = np.full(len(point), np.inf)
    g, r = slope[ahead], whitened[ahead]
    pull = np.einsum("tsi,ts->ti", g, r)
    step = np.linalg.solve(g.transpose(0, 2, 1) @ g, pull[..., None])[..., 0]
    chi2[ahead] = (r**2).sum(axis=1) - np.einsum("ti,ti->t", pull, step)
    return chi2


def _partitions(count: int) -> Iterator[tuple[tuple[int, ...], ...]]:
    """Yield the partitions of ``0 .. count - 1`` into groups."""
    if count == 0:
        yield ()
        return
    last = (count - 1,)
    for groups in _partitions(count - 1):
        for number, group in enumerate(groups):
            yield (*groups[:number], group + last, *groups[number + 1 :])
        yield (*groups, last)


def _check(markers: int, sensors: int, *, least: int) -> None:
    require(markers >= 1, "be at least 1", markers=markers)
    require(sensors >= least, f"be at least {least}", sensors=sensors)
