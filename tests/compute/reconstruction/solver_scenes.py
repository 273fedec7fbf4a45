"""Readings of all kinds for the kernel, and what it has in common with the reference."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from compute.camera.stack import CameraStack
from compute.mapping.table import CorrectionTable, Degree
from compute.reconstruction.point_batch import PointBatch, PointFlag
from compute.reconstruction.triangulation import reconstruct
from tests.compute.reconstruction.distorted_rig import distorted_rig, field_points, table
from tests.compute.rig import rig

Array = NDArray[np.float64]

LOST = PointFlag.TOO_FEW_SENSORS | PointFlag.DEGENERATE | PointFlag.NO_CONVERGENCE


@dataclass(frozen=True, eq=False)
class Scene:
    cameras: CameraStack
    covariance: Array | None
    corrections: CorrectionTable | None
    readings_px: Array
    sigma_px: Array

    def expected(self) -> PointBatch:
        return reconstruct(
            self.cameras, self.readings_px, self.sigma_px, self.covariance, self.corrections
        )


def scene(
    sensors: int,
    *,
    distorted: bool,
    degree: Degree | None,
    calibrated: bool,
    seed: int,
    count: int = 200,
) -> Scene:
    """Noisy readings, a seventh missing, some useless or of points outside of the table's box."""
    rng = np.random.default_rng(seed)
    cameras = CameraStack.of(distorted_rig(sensors) if distorted else rig(sensors))
    corrections = None if degree is None else table(degree, sensors, seed=seed)
    points = field_points(count, seed)
    points[: count // 10] = field_points(count // 10, seed, 500.0)
    readings = cameras.project(points)
    if corrections is not None:
        readings -= corrections.at(points).value_px
        valid = rng.random(corrections.valid.shape) < 0.9
        corrections = CorrectionTable(
            corrections.sensors,
            corrections.calibration_hash,
            corrections.grid,
            corrections.degree,
            corrections.coefficients_px,
            corrections.variance_px2,
            valid,
        )
    sigma = rng.uniform(0.03, 0.2, readings.shape)
    readings += sigma * rng.standard_normal(readings.shape)
    readings[rng.random(readings.shape) < 0.15] = np.nan
    readings[0] = np.nan
    sigma[1] = [np.nan, 0.0, -1.0, *([0.1] * (sensors - 3))]
    sigma[2, -1] = 1e4
    readings[3:9, :2] += [60.0, -60.0]
    return Scene(cameras, parameter_spread(cameras, rng) if calibrated else None, corrections,
                 readings, sigma)  # fmt: skip


def parameter_spread(cameras: CameraStack, rng: np.random.Generator) -> Array:
    """A joint covariance of cameras that move readings by tenths of a pixel."""
    head = np.array([0.2, 0.1, 3e-5, 3e-5, 3e-5, 0.03, 0.03, 0.1])
    counts = cameras.parameter_mask.sum(axis=1)
    scale = np.concatenate([np.append(head, np.full(max(n - 8, 0), 3e-4))[:n] for n in counts])
    mixing = np.eye(len(scale)) + 0.3 * rng.standard_normal((len(scale),) * 2) / len(scale) ** 0.5
    factor = scale[:, None] * mixing
    return np.asarray(factor @ factor.T)


def assert_same(found: PointBatch, expected: PointBatch) -> None:
    """Positions to 1e-9 mm, or to 1e-8 of their own deviation where that is more.

    Covariances to 1e-7, or what the rounding of a matrix of such condition leaves. Of points that
    are uncertain by a metre, one in fifty at most, rounding may decide whether they converge.
    """
    np.testing.assert_array_equal(found.used, expected.used)
    flags = found.flags != expected.flags
    assert flags.mean() <= 0.02
    for batch in (found, expected):
        lost = np.isnan(batch.chi2)
        assert (lost == (batch.flags & LOST != 0)).all()
        assert np.isnan(batch.position_mm[lost]).all()
        assert np.isnan(batch.covariance_mm2[lost]).all()
        assert np.isfinite(batch.position_mm[~lost]).all()
        hopeless = batch.flags & (PointFlag.DEGENERATE | PointFlag.NO_CONVERGENCE) != 0
        uncertain = np.trace(np.nan_to_num(batch.covariance_mm2), axis1=1, axis2=2) > 1000.0**2
        assert (hopeless | uncertain)[flags].all()
    there = np.isfinite(expected.chi2) & np.isfinite(found.chi2)
    covariance, position = expected.covariance_mm2[there], expected.position_mm[there]
    spectrum = np.linalg.eigvalsh(covariance)
    off = np.abs(found.position_mm[there] - position).max(axis=1, initial=0.0)
    assert (off <= np.maximum(1e-9, 1e-8 * np.sqrt(spectrum[:, 2]))).all()
    apart = np.abs(found.covariance_mm2[there] - covariance).max(axis=(1, 2), initial=0.0)
    condition = spectrum[:, 2] / np.maximum(spectrum[:, 0], 1e-14 * spectrum[:, 2])
    assert (apart <= (1e-7 + 1e-14 * condition) * spectrum[:, 2]).all()
    np.testing.assert_allclose(found.chi2[there], expected.chi2[there], rtol=1e-9, atol=1e-9)
    reliability = found.external_reliability_mm[there], expected.external_reliability_mm[there]
    both = np.isfinite(reliability).all(axis=0)
    # Rounding may decide on which side of the least redundancy a reading is.
    assert (np.isinf(reliability[0]) != np.isinf(reliability[1])).sum() <= 0.01 * len(both)
    np.testing.assert_allclose(reliability[0][both], reliability[1][both], rtol=1e-6)
    np.testing.assert_array_equal(np.isnan(found.external_reliability_mm), np.isnan(found.chi2))
