"""Ghosts: [2.15] by counting intersections; the Monte Carlo against enumerated combinations."""

from functools import cache
from itertools import combinations, product
from math import perm

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from compute.camera.stack import CameraStack
from compute.errors import InvalidParameter
from compute.planning.coverage import Box
from compute.planning.ghost_points import (
    GhostProbabilities,
    candidates,
    ghost_probabilities,
    intersecting_points,
)
from compute.reconstruction.correspondence.candidates import FALSE_REJECTION
from compute.reconstruction.triangulation import chi2_limit, reconstruct
from tests.compute.reconstruction.matching import match_peaks
from tests.compute.rig import PIXELS, rig

BOX = Box((0.0, 0.0, 1500.0), (400.0, 400.0, 400.0))


@pytest.mark.parametrize(("markers", "points"), [(1, 1), (2, 8), (3, 21)])
def test_the_figures_of_the_thesis(markers: int, points: int) -> None:
    assert intersecting_points(markers) == points
    assert intersecting_points(markers) == 3 * markers**2 - 2 * markers


@given(st.integers(1, 5), st.integers(2, 4), st.integers(0, 2**32 - 1))
@settings(max_examples=40, deadline=None)
def test_counted_on_random_lines(markers: int, sensors: int, seed: int) -> None:
    """Lines through random markers in the image plane, met pair by pair and counted."""
    rng = np.random.default_rng(seed)
    places = rng.uniform(-1.0, 1.0, (markers, 2))
    angle = np.pi * (np.arange(sensors) + rng.uniform(0.1, 0.6, sensors)) / sensors
    normals = np.column_stack([np.cos(angle), np.sin(angle)])
    offsets = places @ normals.T
    met: list[np.ndarray] = []
    for a, b in combinations(range(sensors), 2):
        for i, j in product(range(markers), repeat=2):
            right = np.array([offsets[i, a], offsets[j, b]])
            met.append(np.linalg.solve(normals[[a, b]], right))
    distinct: list[np.ndarray] = []
    for point in met:
        if all(np.abs(point - other).max() > 1e-9 for other in distinct):
            distinct.append(point)
    assert len(distinct) == intersecting_points(markers, sensors)


def test_in_perspective_every_triple_meets() -> None:
    """N^3 points that fit the readings of three sensors exactly; N of them are markers."""
    markers = 3
    models = rig(3)
    cameras = CameraStack.of(models)
    readings = cameras.project(BOX.uniform(markers, np.random.default_rng(3)))
    choice = np.array(list(product(range(markers), repeat=3)))
    assert len(choice) == candidates(markers, 3) == 27
    mixed = readings[choice, np.arange(3)]
    found = reconstruct(cameras, mixed, np.full(3, 0.1))
    np.testing.assert_allclose(cameras.project(found.position_mm), mixed, atol=1e-6)
    assert len(np.unique(np.round(found.position_mm, 6), axis=0)) == 27


def enumerated(
    cameras: CameraStack, markers: int, frames: int, sigma: np.ndarray, box: Box | None, seed: int
) -> tuple[np.ndarray, np.ndarray]:
    """Consistent wrong combinations of each frame, and whether match_peaks was in doubt."""
    rng = np.random.default_rng(seed)
    sensors = len(cameras)
    choice = np.array(list(product(range(markers), repeat=sensors)))
    wrong = choice[(choice != choice[:, :1]).any(axis=1)]
    limit = chi2_limit(sensors - 3, FALSE_REJECTION)
    readings = cameras.project(BOX.uniform(frames * markers, rng))
    readings = (readings + sigma * rng.standard_normal(readings.shape)).reshape(
        frames, markers, sensors
    )
    mixed = readings[:, wrong, np.arange(sensors)].reshape(-1, sensors)
    found = reconstruct(cameras, mixed, sigma)
    fits = np.isfinite(found.chi2) & (found.chi2 <= limit)
    if box is not None:
        fits &= box.contains(found.position_mm)
    doubts = [
        match_peaks(cameras, frame.T, np.tile(sigma[:, None], (1, markers))).ambiguous.any()
        for frame in (readings if box is None else ())
    ]
    return fits.reshape(frames, -1).sum(axis=1), np.array(doubts)


@pytest.mark.slow
@pytest.mark.parametrize("box", [None, BOX], ids=["anywhere", "inside"])
def test_four_sensors_make_as_many_ghosts_as_planned(box: Box | None) -> None:
    """Noise of a pixel, so that ghosts are frequent enough to be counted."""
    frames, markers = 150, 3
    sigma = np.array([1.6, 2.0, 2.4, 2.0])
    cameras = CameraStack.of(rig(4))
    planned = ghost_probabilities(
        cameras, PIXELS, box, sigma, drawn_from=BOX, trials=6000, seed=1
    ).expected(markers)
    counts, doubts = enumerated(cameras, markers, frames, sigma, box, seed=2)
    error = np.hypot(planned.standard_error, counts.std(ddof=1) / np.sqrt(frames))
    assert counts.sum() > 50  # there is something to compare
    assert abs(counts.mean() - planned.expected) < 4.0 * error
    if box is None:
        # A ghost shares its peaks with markers, and the correspondence says so; it doubts
        # nothing else, as all peaks are explained.
        assert (doubts == (counts > 0)).mean() > 0.99


@pytest.mark.slow
def test_the_limit_is_the_correspondence_s_and_may_be_chosen() -> None:
    cameras = CameraStack.of(rig(4))

    def expected(limit: float | None) -> float:
        return (
            ghost_probabilities(
                cameras, PIXELS, BOX, np.full(4, 0.5), drawn_from=BOX, trials=2000, seed=4,
                limit_sigma=limit,
            )
            .expected(5)
            .expected
        )  # fmt: skip

    standard = expected(None)
    assert standard == expected(chi2_limit(1, FALSE_REJECTION) ** 0.5)
    assert expected(1.0) < standard < expected(20.0)


def test_three_sensors_tell_nothing_apart_but_by_the_volume() -> None:
    cameras = CameraStack.of(rig(3))
    sigma = np.full(3, 0.05)
    anywhere = ghost_probabilities(cameras, PIXELS, None, sigma, drawn_from=BOX, trials=500, seed=1)
    inside = ghost_probabilities(cameras, PIXELS, BOX, sigma, drawn_from=BOX, trials=500, seed=1)
    for markers in (2, 5, 10):
        everywhere = anywhere.expected(markers)
        ghosts = markers**3 - markers
        assert everywhere.candidates == markers**3
        # Some triples meet behind the sensors; no other is refused.
        assert 0.5 * ghosts < everywhere.expected <= ghosts
        assert inside.expected(markers).expected < everywhere.expected


@given(st.integers(1, 12), st.integers(3, 6))
@settings(max_examples=40, deadline=None)
def test_partitions_stand_for_all_combinations(markers: int, sensors: int) -> None:
    probabilities = all_certain(sensors)
    wrong = sum(perm(markers, len(partition)) for partition in probabilities.partitions)
    assert wrong == markers**sensors - markers
    assert probabilities.expected(markers).expected == pytest.approx(wrong)


@cache
def all_certain(sensors: int) -> GhostProbabilities:
    found = ghost_probabilities(
        CameraStack.of(rig(sensors)), PIXELS, BOX, np.full(sensors, 0.1), drawn_from=BOX, trials=1
    )
    count = len(found.partitions)
    return GhostProbabilities(sensors, found.partitions, (1.0,) * count, (0.0,) * count, 1.0)


def test_no_hit_is_not_certainty() -> None:
    sigma = np.full(4, 1e-6)
    found = ghost_probabilities(
        CameraStack.of(rig(4)), PIXELS, BOX, sigma, drawn_from=BOX, trials=100
    ).expected(3)
    assert found.expected == 0.0
    assert found.standard_error > 0.0


def test_the_same_seed_gives_the_same() -> None:
    def once(seed: int) -> GhostProbabilities:
        return ghost_probabilities(
            CameraStack.of(rig(4)), PIXELS, BOX, np.full(4, 5.0), drawn_from=BOX, trials=300,
            seed=seed,
        )  # fmt: skip

    assert once(7) == once(7)
    assert once(7) != once(8)


def test_what_is_refused() -> None:
    cameras = CameraStack.of(rig(4))
    behind = Box((0.0, 0.0, -1500.0), (400.0, 400.0, 400.0))
    with pytest.raises(InvalidParameter, match="0 are seen by all"):
        ghost_probabilities(cameras, PIXELS, BOX, np.full(4, 0.1), drawn_from=behind, trials=10)
    with pytest.raises(InvalidParameter, match="trials is 0"):
        ghost_probabilities(cameras, PIXELS, BOX, np.full(4, 0.1), drawn_from=BOX, trials=0)
    with pytest.raises(InvalidParameter, match="sigma_px"):
        ghost_probabilities(cameras, PIXELS, BOX, np.zeros(4), drawn_from=BOX)
    with pytest.raises(InvalidParameter, match="7 sensors"):
        ghost_probabilities(CameraStack.of(rig(7)), PIXELS, BOX, np.full(7, 0.1), drawn_from=BOX)
    with pytest.raises(InvalidParameter, match="markers is 0"):
        intersecting_points(0)
    with pytest.raises(InvalidParameter, match="sensors is 2"):
        candidates(3, 2)
