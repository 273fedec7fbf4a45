"""Functions of the kernels, one by one on the host, against their definitions in NumPy."""

from ctypes import CDLL, byref, c_bool, c_double, c_int, c_void_p
from math import exp, log

import numpy as np
import pytest
from numpy.typing import NDArray

from compute.camera.stack import CameraStack
from compute.measurement.measurement_model import invert_cubic
from compute.optics.tracing.intersection import intersect, normal
from compute.optics.tracing.surface_records import Form, pack
from compute.optics.tracing.surfaces import Conic, Plane, Surface, SurfaceStack, Toroid
from compute.reconstruction.native.definitions import CAMERAS, fill_cameras
from compute.signal.fit.fit_settings import FitSettings
from compute.signal.fit.line_spread_function import LineSpreadFunction
from compute.signal.fit.native.definitions import pack_plan
from compute.signal.fit.window_model import WindowModel
from compute.tracking.joint_events import ClusterTrack, event_marginals, merge_probability
from compute.tracking.native.definitions import ASSOCIATION
from compute.tracking.settings import TrackerSettings
from compute.transform import exp_so3
from tests.compute.native.host import FUNCTIONS, compiler, run, write_generated
from tests.compute.reconstruction.distorted_rig import distorted_rig, field_points, table

Array = NDArray[np.float64]

pytestmark = pytest.mark.skipif(compiler() is None, reason="no C++ compiler (c++, g++)")


@pytest.fixture(scope="module")
def host(tmp_path_factory: pytest.TempPathFactory) -> CDLL:
    """The library of the functions."""
    folder = tmp_path_factory.mktemp("native")
    write_generated(folder)
    built = folder / "functions.so"
    said = run(folder, "-O1", "-shared", "-fPIC", str(FUNCTIONS), "-o", str(built))
    assert said == ""
    return CDLL(str(built))


def at(array: NDArray[np.generic]) -> c_void_p:
    return c_void_p(array.ctypes.data)


# Rays.


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "shape"),
    [("quadric", Conic(80.0, -0.4)), ("toroid", Toroid(60.0, 45.0, -0.7))],
)
def test_intersections_and_normals_are_those_of_numpy(host: CDLL, name: str, shape) -> None:
    record = pack(SurfaceStack((Surface(shape),), Surface(Plane())))[:1].copy()
    assert record["form"][0] == (Form.QUADRIC if name == "quadric" else Form.TOROID)
    function = getattr(host, f"host_intersect_{name}")
    function.restype = c_double
    rng = np.random.default_rng(1)
    origins = rng.uniform(-30.0, 30.0, (200, 3)) - [0.0, 0.0, 50.0]
    directions = rng.normal(size=(200, 3)) * 0.3 + [0.0, 0.0, 1.0]
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    # From the point next to the vertex, as both begin.
    origins -= (origins * directions).sum(axis=1)[:, None] * directions
    with np.errstate(invalid="ignore"):
        distance, place = intersect(record[0], tuple(origins.T), tuple(directions.T))
    met = np.isfinite(distance)
    assert met.sum() > 20
    least = -1e-9 + (origins * directions).sum(axis=1)
    for ray, (origin, direction) in enumerate(zip(origins, directions, strict=True)):
        found = function(at(record), at(origin), at(direction), c_double(least[ray]))
        assert found == pytest.approx(distance[ray], abs=1e-9, nan_ok=True)
    wanted = np.array(normal(record[0], place)).T
    for point, expected in zip(np.array(place).T[met], wanted[met], strict=True):
        found = np.empty(3)
        host.host_surface_normal(at(record), at(np.ascontiguousarray(point)), at(found))
        assert found == pytest.approx(expected, abs=1e-12)


# Points.


def test_equations_of_three_are_solved(host: CDLL) -> None:
    host.host_solve_ldl.restype = c_double
    rng = np.random.default_rng(2)
    for _ in range(50):
        root = rng.normal(size=(3, 3))
        matrix, right, x = root @ root.T, rng.normal(size=3), np.empty(3)
        lower = matrix[np.tril_indices(3)]
        determinant = host.host_solve_ldl(at(lower), at(right), at(x))
        assert determinant == pytest.approx(np.linalg.det(matrix), rel=1e-6)
        assert matrix @ x == pytest.approx(right, abs=1e-6)


def test_matrix_that_is_not_positive_definite_has_no_factors(host: CDLL) -> None:
    host.host_solve_ldl.restype = c_double
    lower = np.array([1.0, 2.0, 1.0, 0.0, 0.0, 1.0])
    assert np.isnan(host.host_solve_ldl(at(lower), at(np.ones(3)), at(np.empty(3))))


def test_ratio_of_singular_values_is_that_of_numpy(host: CDLL) -> None:
    host.host_singular_ratio.restype = c_double
    rng = np.random.default_rng(3)
    for size in (1.0, 1e-4, 1e-9):
        matrix = rng.normal(size=(3, 3)) * [1.0, 1.0, size]
        values = np.linalg.svd(matrix, compute_uv=False)
        found = host.host_singular_ratio(at(matrix))
        assert found == pytest.approx(values[2] / values[0], rel=1e-6)


class Cameras:
    """Four cameras with distortion, and a table, as the kernels' record."""

    def __init__(self, degree: int) -> None:
        self.stack = CameraStack.of(distorted_rig())
        self.table = table(degree)  # type: ignore[arg-type]
        self.record = np.zeros(1, CAMERAS.dtype)
        self._kept: list[NDArray[np.generic]] = []
        fill_cameras(self.record, self._keep, self.stack, self.table, 4)

    def _keep(self, array: NDArray[np.generic]) -> int:
        self._kept.append(np.ascontiguousarray(array))
        return int(self._kept[-1].ctypes.data)


def test_projection_and_its_derivatives_are_those_of_the_cameras(host: CDLL) -> None:
    cameras = Cameras(1)
    points = field_points(50, seed=4)
    readings, gradients = cameras.stack.linearise(points)
    jacobians = cameras.stack.parameter_jacobian(points)
    for point, reading, gradient, jacobian in zip(
        points, readings, gradients, jacobians, strict=True
    ):
        found, by_point = np.empty(4), np.empty((4, 3))
        host.host_project(at(cameras.record), at(point), at(found), at(by_point))
        assert found == pytest.approx(reading, rel=1e-13, nan_ok=True)
        assert by_point == pytest.approx(gradient, rel=1e-11, nan_ok=True)
        for sensor in range(4):
            row = np.zeros(16)
            width = host.host_parameter_jacobian(
                at(cameras.record), c_int(sensor), at(point), at(row)
            )
            assert width == cameras.stack.width
            owned = cameras.stack.parameter_mask[sensor]
            wanted = np.nan_to_num(jacobian[sensor])
            assert row[:width][owned] == pytest.approx(wanted[owned], rel=1e-10, abs=1e-10)


@pytest.mark.parametrize("degree", [1, 3])
def test_corrections_are_those_of_the_table(host: CDLL, degree: int) -> None:
    host.host_correction.restype = c_bool
    cameras = Cameras(degree)
    points = np.concatenate([field_points(40, seed=5), field_points(10, seed=6, extent_mm=600.0)])
    wanted = cameras.table.at(points)
    for index, point in enumerate(points):
        value, gradient, variance = np.empty(4), np.empty((4, 3)), np.empty(4)
        valid = host.host_correction(
            at(cameras.record), at(point), at(value), at(gradient), at(variance)
        )
        assert value == pytest.approx(wanted.value_px[index], rel=1e-11, abs=1e-12)
        assert gradient == pytest.approx(wanted.gradient_px_per_mm[index], rel=1e-10, abs=1e-13)
        assert variance == pytest.approx(wanted.variance_px2[index], rel=1e-11)
        assert valid == wanted.inside[index].all()


@pytest.mark.parametrize("share", [-0.3, -0.1, -0.003, 0.003, 0.1, 1.0])
def test_inverse_of_the_cubic_distortion_is_exact_to_the_last_digits(
    host: CDLL, share: float
) -> None:
    """``share``: distortion at the sensor's end, in parts of the distance from p0."""
    host.host_invert_cubic.restype = c_double
    principal_point, half_length = 1024.0, 1024.0
    cubic = share / half_length**2
    readings = principal_point + half_length * np.linspace(-1.0, 1.0, 401)
    offsets = readings - principal_point
    projected = readings + cubic * offsets**3
    expected = invert_cubic(projected[:, None], np.array([principal_point]), np.array([cubic]))
    derivative = c_double()
    for value, reading, offset in zip(projected, expected[:, 0], offsets, strict=True):
        inverted = host.host_invert_cubic(
            c_double(value), c_double(principal_point), c_double(cubic), byref(derivative)
        )
        # An error of one rounding grows by the derivative, 10 where the distortion nearly folds.
        tolerance = 4.0 * np.spacing(2048.0) * max(derivative.value, 1.0)
        assert inverted == pytest.approx(reading, rel=0.0, abs=tolerance)
        assert derivative.value == pytest.approx(1.0 / (1.0 + 3.0 * cubic * offset**2), rel=1e-12)


@pytest.mark.parametrize("beyond", [1.001, 1.1, 5.0])
def test_no_reading_projects_beyond_the_fold(host: CDLL, beyond: float) -> None:
    host.host_invert_cubic.restype = c_double
    principal_point, cubic = 1024.0, -1e-7
    fold = 1.0 / np.sqrt(-3.0 * cubic)
    projected = principal_point + beyond * (fold + cubic * fold**3)
    inverted = host.host_invert_cubic(
        c_double(projected), c_double(principal_point), c_double(cubic), byref(c_double())
    )
    assert np.isnan(inverted)
    assert np.isnan(
        invert_cubic(np.array([projected]), np.array([principal_point]), np.array([cubic]))[0]
    )


# Tracks.


def test_merge_probability_is_its_definition(host: CDLL) -> None:
    host.host_merge_probability.restype = c_double
    for arguments in ((0.0, 0.0, 3.0), (1.5, 0.2, 3.0), (-9.0, 4.0, 2.0)):
        found = host.host_merge_probability(*(c_double(value) for value in arguments))
        assert found == pytest.approx(merge_probability(*arguments), rel=1e-13)


def test_cholesky_root_and_its_determinant(host: CDLL) -> None:
    host.host_log_determinant.restype = c_double
    rng = np.random.default_rng(7)
    for size in range(1, 5):
        root = rng.normal(size=(size, size))
        matrix = root @ root.T + 0.1 * np.eye(size)
        rows = np.zeros((4, 4))
        rows[:size, :size] = matrix
        found = host.host_log_determinant(at(rows), c_int(size))
        assert found == pytest.approx(np.linalg.slogdet(matrix)[1], abs=1e-10)
        lower = np.tril(rows[:size, :size])
        assert lower @ lower.T == pytest.approx(matrix, abs=1e-10)


@pytest.mark.parametrize("seed", range(8))
def test_probabilities_of_joint_events_are_their_definition(host: CDLL, seed: int) -> None:
    rng = np.random.default_rng(seed)
    settings = TrackerSettings()
    tracks, peaks = int(rng.integers(1, 5)), int(rng.integers(1, 6))
    position, variance = rng.uniform(0.0, 12.0, tracks), rng.uniform(0.01, 1.0, tracks)
    reading, noise = rng.uniform(-1.0, 13.0, peaks), rng.uniform(0.002, 0.02, peaks)
    job = np.zeros(1, ASSOCIATION.dtype)
    for name in ("detection_probability", "clutter_density_per_px", "resolution_px", "gate_sigma"):
        job[name] = getattr(settings, name)
    job["max_hypotheses"], job["max_grown"] = 400, 60_000
    own, shared = np.zeros((tracks, peaks)), np.zeros((tracks, peaks))
    arrays = (at(position), at(variance), c_int(peaks), at(reading), at(noise), at(own), at(shared))
    assert host.host_joint_events(at(job), c_int(tracks), *arrays) >= 0
    contenders = [ClusterTrack(*pair) for pair in zip(position, variance, strict=True)]
    given = [(k, reading[k], noise[k]) for k in range(peaks)]
    wanted_own, wanted_shared = np.zeros_like(own), np.zeros_like(shared)
    for track, found in enumerate(event_marginals(contenders, given, settings)[0]):
        for claim in found:
            target = wanted_shared if claim.merged else wanted_own
            target[track, claim.peak] += claim.probability
    assert own == pytest.approx(wanted_own, abs=1e-9)
    assert shared == pytest.approx(wanted_shared, abs=1e-9)


# Poses.


@pytest.mark.parametrize("angle", [0.0, 1e-6, 1e-3, 0.5, 3.0])
def test_rotation_is_that_of_its_vector(host: CDLL, angle: float) -> None:
    vector = angle * np.array([0.48, -0.6, 0.64])
    found = np.empty((3, 3))
    host.host_rotation_matrix(at(vector), at(found))
    assert found == pytest.approx(exp_so3(vector), abs=1e-15)


# Peaks.


def test_logarithm_and_exponential(host: CDLL) -> None:
    host.host_log.restype = host.host_exp.restype = c_double
    for value in np.concatenate([np.geomspace(1e-300, 1e300, 400), np.linspace(0.5, 2.0, 101)]):
        assert host.host_log(c_double(value)) == pytest.approx(log(value), rel=4e-16, abs=2e-16)
    for value in np.linspace(-20.0, 20.0, 401):
        assert host.host_exp(c_double(value)) == pytest.approx(exp(value), rel=1e-13)


def test_line_spread_function_is_the_shape(host: CDLL) -> None:
    host.host_central_fraction.restype = c_double
    shape = LineSpreadFunction.gaussian()
    plan = pack_plan(FitSettings(), shape)
    for t in np.linspace(-5.9, 5.9, 97):
        found = np.empty(2)
        host.host_edge(at(plan), c_double(100.0), c_double(t), at(found))
        share, density = shape.at(np.asarray(t))
        assert found == pytest.approx([float(share), float(density)], abs=1e-14)
    for width in (0.4, 1.0, 2.5):
        found_share = host.host_central_fraction(at(plan), c_double(100.0), c_double(width))
        model = WindowModel(1, FitSettings(), shape)
        wanted = model.central_pixel_fraction(np.array([width]), np.array([0]), np.array([100.0]))
        assert found_share == pytest.approx(float(wanted[0]), rel=1e-13)


def test_threshold_is_that_fraction_of_a_peak(host: CDLL) -> None:
    from compute.signal.centroid_settings import FRACTION_UNIT, LEVEL_UNIT

    for background, value, units in ((640, 50, 300), (6_400, 4095, FRACTION_UNIT // 2)):
        excess = value * LEVEL_UNIT - background
        wanted = background + excess * units // FRACTION_UNIT
        assert host.host_threshold(background, value, units) == wanted
