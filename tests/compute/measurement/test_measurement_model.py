"""Predicted readings: uncorrected ones, beside what the reconstruction makes of them."""

from dataclasses import replace

import numpy as np
import pytest

from compute.camera.stack import CameraStack
from compute.errors import InvalidParameter
from compute.mapping.grid import VoxelGrid
from compute.mapping.table import CorrectionTable
from compute.measurement.measurement_model import MeasurementModel
from compute.reconstruction.triangulation import reconstruct
from tests.compute.distorted_rig import distorted_rig
from tests.compute.rig import control_points, rig

CELLS = 6


def table(sensors: int = 4) -> CorrectionTable:
    """Corrections of some pixels that vary over space, with a variance."""
    rng = np.random.default_rng(0)
    return CorrectionTable(
        tuple(f"s{n}" for n in range(sensors)),
        "0" * 64,
        VoxelGrid((-300.0, -300.0, 1200.0), (100.0,) * 3, (CELLS,) * 3),
        3,
        2.0 * rng.standard_normal((sensors, CELLS + 3, CELLS + 3, CELLS + 3)),
        rng.uniform(0.001, 0.01, (sensors, CELLS + 1, CELLS + 1, CELLS + 1)),
        np.ones((sensors, CELLS, CELLS, CELLS), dtype=np.bool_),
    )


def cubic_rig() -> CameraStack:
    return CameraStack.of([replace(model, cubic_per_px2=3e-9) for model in rig()])


@pytest.mark.parametrize("kind", ["plain", "cubic", "distorted", "corrected", "all"])
def test_predicted_readings_reconstruct_to_the_place(kind: str) -> None:
    cameras = CameraStack.of(rig())
    if kind in ("cubic", "all"):
        cameras = cubic_rig()
    if kind == "distorted":
        cameras = CameraStack.of(distorted_rig(((2, 1), (0, 3), (3, 0))))
    corrections = table() if kind in ("corrected", "all") else None
    places = control_points(12)
    model = MeasurementModel(cameras, None, corrections)
    predicted = model.predict(places)
    points = reconstruct(cameras, predicted.reading_px, np.full(4, 0.05), None, corrections)
    assert np.abs(points.position_mm - places).max() < 1e-5
    step = 1e-3
    for axis in range(3):
        moved = np.zeros(3)
        moved[axis] = step
        more, less = model.predict(places + moved), model.predict(places - moved)
        jacobian = (more.reading_px - less.reading_px) / (2.0 * step)
        assert np.abs(predicted.jacobian_px_per_mm[..., axis] - jacobian).max() < 1e-5


def test_constant_errors_are_those_of_reconstruction() -> None:
    """Weighed least squares with them gives the covariance that ``reconstruct`` states."""
    cameras, corrections = cubic_rig(), table()
    rng = np.random.default_rng(1)
    count = int(cameras.parameter_mask.sum())
    root = np.diag(np.tile([0.5, 0.5, 1e-4, 1e-4, 1e-4, 0.05, 0.05], 4))
    mixing = np.eye(count) + 0.3 * rng.standard_normal((count, count))
    covariance = root @ mixing @ mixing.T @ root
    places = control_points(5)
    model = MeasurementModel(cameras, covariance, corrections)
    predicted = model.predict(places)
    stated = reconstruct(
        cameras, predicted.reading_px, np.full(4, 0.05), covariance, corrections
    ).covariance_mm2
    for place, own in enumerate(model.systematic_covariance(places)):
        weight = np.linalg.inv(own + 0.05**2 * np.eye(4))
        jacobian = predicted.jacobian_px_per_mm[place]
        right = np.linalg.inv(jacobian.T @ weight @ jacobian)
        assert np.allclose(right, stated[place], rtol=0.02)


def test_the_tables_variance_is_a_constant_error() -> None:
    corrections, places = table(), control_points(5)
    own = MeasurementModel(CameraStack.of(rig()), None, corrections).systematic_covariance(places)
    assert np.allclose(np.diagonal(own, axis1=1, axis2=2), corrections.at(places).variance_px2)
    assert np.count_nonzero(own) == own.shape[0] * own.shape[1]


def test_what_is_out_of_view_is_said_so() -> None:
    model = MeasurementModel(CameraStack.of(rig()), pixels=(2048,) * 4)
    predicted = model.predict(np.array([[0.0, 0.0, 1500.0], [0.0, 0.0, -1500.0], [9e3, 0, 1500]]))
    assert predicted.in_view[0].all()
    assert not predicted.in_view[1].any()
    assert not predicted.in_view[2].all()


def test_refusals_name_the_value() -> None:
    cameras = CameraStack.of(rig())
    with pytest.raises(InvalidParameter, match=r"\(3, 3\).*28 parameters"):
        MeasurementModel(cameras, np.eye(3))
    with pytest.raises(InvalidParameter, match="table is of 3 sensors"):
        MeasurementModel(cameras, corrections=table(3))
    with pytest.raises(InvalidParameter, match=r"\(2048,\).*4 sensors"):
        MeasurementModel(cameras, pixels=(2048,))
