"""Cameras from readings alone against a free bundle adjustment from the truth (an oracle)."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

import validation.wand_from_readings.case as case
from compute.calibration.self_calibration.self_calibrate import self_calibrate
from compute.calibration.self_calibration.targets import Recording, Wand
from compute.camera.model import SensorGeometry, SensorModel
from tests.oracles.wand_bundle import WandBundle
from validation.wand_from_readings.scene import Bar, Wave

Array = NDArray[np.float64]


def _true_matrices(bar: Bar) -> Array:
    right, forward = (
        np.column_stack(
            [bar.rotation[:, k], -np.einsum("si,si->s", bar.rotation[:, k], bar.lens_mm)]
        )
        for k in (0, 2)
    )
    first = bar.distance_px[:, None] * right + bar.point_px[:, None] * forward
    return np.stack([first, forward], axis=1)


def _matrices(models: tuple[SensorModel, ...]) -> Array:
    rows = []
    for model in models:
        right = np.append(model.rotation[0], model.offset_x_mm)
        forward = np.append(model.rotation[2], model.offset_z_mm)
        first = model.principal_distance_px * right + model.principal_point_px * forward
        rows.append(np.stack([first, forward]))
    return np.array(rows)


def _over_sigma(matrices: Array, sigma_px: float) -> Array:
    scale = np.array([1.0 / sigma_px, 1.0])
    return np.asarray(matrices * scale[:, None])


def _from_truth(wave: Wave, readings: Array) -> WandBundle:
    kept = (np.isfinite(readings).sum(axis=2) >= 3).all(axis=1)
    ends = wave.markers_mm[kept]
    between = ends[:, 1] - ends[:, 0]
    direction = between / np.linalg.norm(between, axis=1, keepdims=True)
    matrices = _over_sigma(_true_matrices(wave.bar), wave.sigma_px)
    start = WandBundle(
        matrices, ends.mean(axis=1), direction, wave.bar.wand_mm, readings[kept] / wave.sigma_px
    )
    return start.minimised(200, cameras_free=False).minimised()


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "trial"), [(93001, 117), (93001, 99), (93001, 21), (18001, 4)])
def test_four_sensors_end_at_or_below_the_minimum_from_the_truth(seed: int, trial: int) -> None:
    """A third of the readings is missing; 117 ended 84 mm off, with seven poses left out.

    Trials 21 and 4 were refused: three of their markers lie beyond the plane at infinity.
    """
    row = next(one for one in case.ROWS if one.always)
    wave = case.draw_wave(row, seed, trial)
    exact = wave.bar.read(wave.markers_mm)
    right = np.where(
        np.abs(wave.readings_px - exact) < 6.0 * wave.sigma_px, wave.readings_px, np.nan
    )
    recording = Recording(
        Wand((0.0, wave.bar.wand_mm)),
        wave.readings_px,
        np.full(wave.readings_px.shape, wave.sigma_px),
    )
    sensors = [SensorGeometry(f"s{k}", wave.bar.pixels) for k in range(4)]
    found = self_calibrate(sensors, [recording], directions_deg=wave.directions_deg)
    truth = _from_truth(wave, right)
    matrices = _over_sigma(_matrices(found.calibration.models), wave.sigma_px)
    ours = WandBundle.placed(matrices, wave.bar.wand_mm, right / wave.sigma_px).minimised()
    assert ours.chi2.sum() < truth.chi2.sum() + 1.0


def test_oracle_keeps_the_minimum_of_exact_readings() -> None:
    row = next(one for one in case.ROWS if one.always)
    wave = case.draw_wave(row, 5, 0)
    exact = np.where(np.isnan(wave.readings_px), np.nan, wave.bar.read(wave.markers_mm))
    found = _from_truth(wave, exact)
    assert found.chi2.max() < 1e-12
    moved = replace(found, matrices=found.matrices * (1.0 + 1e-4 * np.arange(4)[:, None, None]))
    moved = replace(moved, centre=found.centre + 1.0)
    assert moved.minimised().chi2.sum() < 1e-6
