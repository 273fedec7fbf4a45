"""The kernel on the CPU: the same points, flags and covariances as the reference's."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from compute.camera.field_distortion import FieldDistortion
from compute.camera.stack import CameraStack
from compute.errors import InvalidParameter
from compute.mapping.table import Degree
from compute.native.native_kernel import native_kernel
from compute.reconstruction.point_batch import PointFlag
from compute.reconstruction.solver import MIN_CAPACITY, PointSolver, load_kernels, point_kernel
from compute.reconstruction.triangulation import reconstruct
from tests.compute.reconstruction.distorted_rig import distorted_rig, field_points, table
from tests.compute.reconstruction.solver_scenes import Scene, assert_same, scene
from tests.compute.rig import camera, rig

Array = NDArray[np.float64]


def solver_of(given_: Scene, threads: int | None = None) -> PointSolver:
    return PointSolver(
        given_.cameras, given_.covariance, given_.corrections, device="cpu", threads=threads
    )


@pytest.mark.slow
@settings(deadline=None, max_examples=60)
@given(
    st.sampled_from([3, 4]),
    st.booleans(),
    st.sampled_from([None, 1, 3]),
    st.booleans(),
    st.integers(0, 10**6),
)
def test_any_scene_is_solved_as_by_the_reference(
    sensors: int, distorted: bool, degree: Degree | None, calibrated: bool, seed: int
) -> None:
    made = scene(sensors, distorted=distorted, degree=degree, calibrated=calibrated, seed=seed)
    expected = made.expected()
    assert_same(solver_of(made).solve(made.readings_px, made.sigma_px), expected)


def test_scenes_have_all_kinds_of_points() -> None:
    made = scene(4, distorted=True, degree=3, calibrated=True, seed=1, count=1000)
    flags = made.expected().flags
    for flag in (
        PointFlag.TOO_FEW_SENSORS,
        PointFlag.NO_REDUNDANCY,
        PointFlag.INCONSISTENT,
        PointFlag.OUTSIDE_MAP,
    ):
        assert (flags & flag > 0).any()
        assert not (flags & flag > 0).all()


def test_twenty_eight_sensors() -> None:
    made = scene(28, distorted=True, degree=3, calibrated=True, seed=28, count=60)
    assert_same(solver_of(made).solve(made.readings_px, made.sigma_px), made.expected())


def test_threads_share_a_large_batch() -> None:
    made = scene(4, distorted=True, degree=3, calibrated=True, seed=5, count=5001)
    one = solver_of(made, 1).solve(made.readings_px, made.sigma_px)
    many = solver_of(made, 3).solve(made.readings_px, made.sigma_px)
    for name in (
        "position_mm",
        "covariance_mm2",
        "chi2",
        "external_reliability_mm",
        "used",
        "flags",
    ):
        np.testing.assert_array_equal(getattr(one, name), getattr(many, name))


def test_planes_in_a_line_and_nearly_so() -> None:
    """Sensors that all read horizontally, one of them turned by less and less."""
    target = np.array([0.0, 0.0, 1500.0])
    point = np.array([[10.0, 40.0, 1400.0]])
    kinds = set()
    for turned in (0.0, 1e-13, 1e-9, 1e-5, 1e-2):
        models = tuple(
            camera(f"s{i}", np.array([x, 0.0, 0.0]), turned * (i == 2), target)
            for i, x in enumerate([-200.0, 0.0, 200.0])
        )
        cameras = CameraStack.of(models)
        readings, sigma = cameras.project(point), np.full(3, 0.01)
        expected = reconstruct(cameras, readings, sigma)
        found = PointSolver(cameras, device="cpu").solve(readings, sigma)
        kinds.add(int(expected.flags[0]))
        assert found.flags[0] == expected.flags[0]
        if np.isfinite(expected.chi2[0]):
            deviation = np.sqrt(np.trace(expected.covariance_mm2[0]))
            assert np.abs(found.position_mm - expected.position_mm).max() < 1e-6 * deviation
    assert kinds == {PointFlag.DEGENERATE, PointFlag.NO_REDUNDANCY}


def test_readings_of_a_point_behind_the_lenses() -> None:
    """A camera reads alike in front and behind: the planes meet where nothing is seen from."""
    cameras = CameraStack.of(rig())
    points = field_points(20, 3) * [1.0, 1.0, -1.0]
    sensor = np.einsum("sij,nj->nsi", cameras.rotation, points) + cameras.offset_mm
    u = sensor[..., 0] / sensor[..., 2]
    readings = cameras.principal_point_px + cameras.principal_distance_px * u
    expected = reconstruct(cameras, readings, np.full(4, 0.1))
    assert (expected.flags == PointFlag.NO_CONVERGENCE).all()
    assert_same(PointSolver(cameras, device="cpu").solve(readings, np.full(4, 0.1)), expected)


def test_wild_readings_are_refused_alike() -> None:
    rng = np.random.default_rng(4)
    cameras, corrections = CameraStack.of(distorted_rig()), table(3)
    readings = rng.uniform(-1e4, 1e4, (300, 4))
    readings[:4] = [[np.inf, 1, 2, 3], [1e12] * 4, [-np.inf] * 4, [0.0] * 4]
    expected = reconstruct(cameras, readings, np.full(4, 0.1), corrections=corrections)
    found = PointSolver(cameras, None, corrections, "cpu").solve(readings, np.full(4, 0.1))
    np.testing.assert_array_equal(found.used, expected.used)
    # Where nothing fits, rounding decides at which of the turns it is given up.
    same = np.isnan(found.chi2) == np.isnan(expected.chi2)
    assert same.mean() > 0.97
    assert np.isnan(expected.chi2).any()
    refused = np.isnan(found.chi2)
    assert (found.flags[refused] != 0).all()
    assert np.isnan(found.position_mm[refused]).all()
    assert np.isfinite(found.position_mm[~refused]).all()


def test_three_readings_that_meet_nowhere_near_are_no_point() -> None:
    """A steep and ragged table holds the search where residuals are least and not zero."""
    cameras, points = CameraStack.of(rig(3)), field_points(4000, 1)
    smooth = table(1, 3)
    ragged = np.random.default_rng(3).uniform(-100.0, 100.0, smooth.coefficients_px.shape)
    corrections = replace(smooth, coefficients_px=ragged)
    readings = cameras.project(points) - corrections.at(points).value_px
    sigma = np.full(3, 0.05)
    expected = reconstruct(cameras, readings, sigma, corrections=corrections)
    found = PointSolver(cameras, None, corrections, "cpu").solve(readings, sigma)
    np.testing.assert_array_equal(found.flags, expected.flags)
    for batch in (found, expected):
        there = np.isfinite(batch.chi2)
        assert 0.2 < there.mean() < 0.95
        assert batch.chi2[there].max() < 1e-12
        assert (batch.flags[~there] == PointFlag.NO_CONVERGENCE).all()


def test_a_cubic_term() -> None:
    made = scene(4, distorted=True, degree=3, calibrated=True, seed=9)
    cameras = CameraStack.of([replace(model, cubic_per_px2=3e-8) for model in distorted_rig()])
    made = replace(made, cameras=cameras)
    assert_same(solver_of(made).solve(made.readings_px, made.sigma_px), made.expected())


@pytest.mark.slow
def test_high_powers_and_many_terms() -> None:
    terms = tuple((i, j) for i in range(8) for j in range(8) if i + j > 2)[:40]
    models = [
        replace(model, distortion=FieldDistortion(terms, (1e-3,) * len(terms))) for model in rig()
    ]
    points = field_points(50, 2)
    cameras = CameraStack.of(models)
    readings, sigma = cameras.project(points), np.full(4, 0.1)
    solver = PointSolver(models, device="cpu")
    assert_same(solver.solve(readings, sigma), reconstruct(models, readings, sigma))


def test_calibrations_share_a_kernel() -> None:
    """No switch of the same device compiles: terms, table and covariance are data."""
    load_kernels(4, "cpu")
    before = native_kernel.cache_info().misses
    for seed, (distorted, degree) in enumerate([(False, None), (True, 1), (True, 3)]):
        made = scene(4, distorted=distorted, degree=degree, calibrated=True, seed=seed)
        solver_of(made)
    fewer = FieldDistortion(((3, 0),), (0.1,))
    PointSolver([replace(model, distortion=fewer) for model in rig()], device="cpu")
    assert native_kernel.cache_info().misses == before


def test_kernels_are_loaded_in_the_build_that_is_launched(monkeypatch: pytest.MonkeyPatch) -> None:
    made = scene(4, distorted=True, degree=None, calibrated=False, seed=2)
    modules = [point_kernel(4, room).module for room in (0, MIN_CAPACITY)]
    for module in modules:
        monkeypatch.setattr(module, "execs", {})  # what other tests have loaded
    load_kernels(4, "cpu")
    loaded = [set(module.execs) for module in modules]
    assert all(loaded)
    solver_of(made).solve(made.readings_px, made.sigma_px)
    assert [set(module.execs) for module in modules] == loaded


def test_solvers_stand_beside_one_another() -> None:
    first = scene(4, distorted=False, degree=3, calibrated=True, seed=1)
    second = scene(4, distorted=False, degree=1, calibrated=False, seed=2)
    solvers = [solver_of(first), solver_of(second)]
    for made, solver in zip((first, second), solvers, strict=True):
        assert_same(solver.solve(made.readings_px, made.sigma_px), made.expected())


def test_points_stand_after_the_next_call() -> None:
    made = scene(4, distorted=False, degree=None, calibrated=False, seed=1)
    solver = solver_of(made)
    points = solver.solve(made.readings_px, made.sigma_px)
    kept = points.position_mm.copy()
    solver.solve(made.readings_px + 5.0, made.sigma_px)
    np.testing.assert_array_equal(points.position_mm, kept)


def test_no_points_and_deviations_of_sensors() -> None:
    made = scene(4, distorted=False, degree=None, calibrated=False, seed=3)
    solver = solver_of(made)
    assert len(solver.solve(np.empty((0, 4)), np.ones(4))) == 0
    expected = reconstruct(made.cameras, made.readings_px, np.full(4, 0.1))
    assert_same(solver.solve(made.readings_px, np.full(4, 0.1)), expected)


@pytest.mark.parametrize(
    ("readings", "sigma", "words"),
    [
        (np.ones((2, 3)), np.ones(4), r"shape \(2, 3\); it must be \(N, 4\)"),
        (np.ones(4), np.ones(4), r"shape \(4,\); it must be \(N, 4\)"),
        (np.ones((2, 4)), np.ones(2), r"sigma_px has the shape \(2,\)"),
    ],
)
def test_other_shapes_are_refused(readings: Array, sigma: Array, words: str) -> None:
    with pytest.raises(InvalidParameter, match=words):
        PointSolver(rig(), device="cpu").solve(readings, sigma)


def test_what_a_solver_refuses() -> None:
    with pytest.raises(InvalidParameter, match="cameras have 28 parameters"):
        PointSolver(rig(), np.eye(4), device="cpu")
    with pytest.raises(InvalidParameter, match="of 3 sensors; there are 4 cameras"):
        PointSolver(rig(), None, table(1, 3), device="cpu")
    high = FieldDistortion(((16, 0),), (0.1,))
    with pytest.raises(InvalidParameter, match=r"powers \(16, 0\)"):
        PointSolver([replace(model, distortion=high) for model in rig()], device="cpu")
    with pytest.raises(InvalidParameter, match="there must be 1 to 64"):
        PointSolver(rig(65), device="cpu")
    with pytest.raises(InvalidParameter, match="no device 'tpu'"):
        PointSolver(rig(), device="tpu")
