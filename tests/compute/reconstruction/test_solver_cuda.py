"""The kernel on CUDA against the reference; needs a CUDA device, and no plugin of pytest."""

import numpy as np
import pytest

from compute.reconstruction.native.cuda_launch import DIRECT_POINTS, POINTS_PER_LAUNCH
from compute.reconstruction.solver import PointSolver
from tests.compute.reconstruction.solver_scenes import assert_same, scene


@pytest.fixture(scope="module")
def device():
    import warp as wp

    if not wp.is_cuda_available():
        pytest.skip("no CUDA device")
    return "cuda:0"


@pytest.mark.parametrize("calibrated", [False, True])
@pytest.mark.parametrize("degree", [None, 1, 3])
@pytest.mark.parametrize("distorted", [False, True])
@pytest.mark.parametrize("sensors", [3, 4, 7, 28])
def test_matches_the_reference(device, sensors, distorted, degree, calibrated):
    made = scene(sensors, distorted=distorted, degree=degree, calibrated=calibrated, seed=sensors)
    solver = PointSolver(made.cameras, made.covariance, made.corrections, device)
    assert_same(solver.solve(made.readings_px, made.sigma_px), made.expected())


def test_batches_of_any_size(device):
    made = scene(4, distorted=True, degree=3, calibrated=True, seed=3, count=500)
    solver = PointSolver(made.cameras, made.covariance, made.corrections, device)
    expected = made.expected()
    for count in (1, 500, DIRECT_POINTS, DIRECT_POINTS + 1, 2 * POINTS_PER_LAUNCH + 77, 3):
        index = np.arange(count) % 500
        found = solver.solve(made.readings_px[index], made.sigma_px[index])
        np.testing.assert_array_equal(found.flags, expected.flags[index])
        np.testing.assert_array_equal(found.used, expected.used[index])
        np.testing.assert_allclose(
            found.position_mm, expected.position_mm[index], rtol=0, atol=1e-7
        )
    assert len(solver.solve(np.empty((0, 4)), np.ones(4))) == 0
