"""Holes between measurements: found by the measurements' own local spacing, and only there."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from compute.mapping.cell_support import within_hull
from compute.mapping.coverage import Coverage
from compute.mapping.grid import mesh_points

SIDE = 100.0


def at_random(count, seed):
    return SIDE * np.random.default_rng(seed).uniform(size=(count, 3))


def jittered(number, seed, stretch=(1, 1, 1)):
    numbers = number * np.array(stretch)
    axes = [(np.arange(one) + 0.5) / one for one in numbers]
    points = mesh_points(axes)
    step = 0.5 / numbers
    return SIDE * (points + step * np.random.default_rng(seed).uniform(-0.5, 0.5, points.shape))


def two_densities(ratio, seed):
    points = at_random(600, seed)
    sparse = points[:, 0] < 0.5 * SIDE
    keep = np.random.default_rng(seed + 1).uniform(size=600) < 1.0 / ratio
    return points[~sparse | keep]


@pytest.mark.parametrize(
    "points",
    [
        at_random(300, 1),
        jittered(6, 2),
        jittered(4, 3, (4, 1, 1)),
        jittered(4, 4, (2, 2, 1)),
        jittered(6, 5)[np.random.default_rng(6).uniform(size=216) > 0.1],
        two_densities(2.0, 7),
        two_densities(4.0, 9),
    ],
    ids=["random", "jittered", "scan lines", "slices", "10 % lost", "2:1", "4:1"],
)
def test_no_holes_in_volumes_measured_throughout(points):
    positions = at_random(2000, 0)
    assert Coverage.of(points).in_hole(positions).mean() < 0.02


@pytest.mark.slow
@pytest.mark.parametrize("points", [at_random(500, 11), jittered(8, 12)], ids=["random", "grid"])
@pytest.mark.parametrize("radius", [30.0, 42.0])
def test_a_ball_without_measurements_is_a_hole(points, radius):
    centre = np.array([50.0, 48.0, 45.0])
    holed = points[np.linalg.norm(points - centre, axis=1) > radius]
    coverage = Coverage.of(holed)
    positions = at_random(5000, 13)
    distance = np.linalg.norm(positions - centre, axis=1)
    found = coverage.in_hole(positions)
    assert found[distance < 0.95 * radius].all()
    assert found[distance > radius + 15.0].mean() < 0.03
    hole = coverage.largest_hole
    assert hole is not None
    assert np.linalg.norm(np.array(hole.centre_mm) - centre) < 10.0
    assert hole.diameter_mm == pytest.approx(2.0 * radius, rel=0.2)
    assert coverage.largest_gap_mm < 2.0 * radius


def test_a_hole_among_dense_points_is_smaller_than_gaps_of_sparse_ones():
    points = two_densities(8.0, 15)
    centre = np.array([75.0, 50.0, 50.0])
    holed = points[np.linalg.norm(points - centre, axis=1) > 20.0]
    coverage = Coverage.of(holed)
    assert coverage.in_hole(centre[None]).all()
    positions = at_random(4000, 16)
    assert coverage.in_hole(positions[positions[:, 0] < 40.0]).mean() < 0.1


def test_flat_points_have_no_volume():
    flat = at_random(30, 17) * [1.0, 1.0, 0.0]
    coverage = Coverage.of(flat)
    assert coverage.largest_hole is None
    assert coverage.resolution_mm == 0.0


@pytest.mark.parametrize("seed", [20, 21, 22])
def test_coverage_slab_hole_among_regular_points_is_found(seed):
    # A hole of a third of the volume widens the gap that 95 % of the volume does not reach.
    points = jittered(7, seed)
    holed = points[np.abs(points[:, 1] - 50.0) > 17.0]
    coverage = Coverage.of(holed)
    positions = at_random(4000, 23)
    distance = np.abs(positions[:, 1] - 50.0)
    assert coverage.in_hole(positions[distance < 10.0]).mean() > 0.95
    assert coverage.in_hole(positions[distance > 35.0]).mean() < 0.02


@pytest.mark.parametrize("seed", [24, 25, 26])
def test_largest_gap_random_points_is_no_smaller_than_any_gap(seed):
    points = at_random(200, seed)
    coverage = Coverage.of(points)
    positions = at_random(40_000, 27)
    positions = positions[within_hull(points, positions) & ~coverage.in_hole(positions)]
    gaps = 2.0 * np.asarray(cKDTree(points).query(positions)[0])
    # On the hull's surface the largest gap is found on a lattice.
    assert gaps.max() <= 1.01 * coverage.largest_gap_mm
