"""Lengths at poses held out: honest beside the true cameras, and larger than those fitted."""

from dataclasses import replace

import numpy as np
import pytest

from compute.calibration.self_calibration.held_out_lengths import held_out_lengths
from compute.calibration.self_calibration.self_calibrate import self_calibrate
from compute.calibration.self_calibration.targets import Recording, Wand
from compute.reconstruction.triangulation import reconstruct
from tests.compute.calibration.self_calibration.scenes import (
    SIGMA_PX,
    WAND_MM,
    noisy,
    wand_markers,
)
from tests.compute.rig import rig

WAND = Wand((0.0, WAND_MM))


def _recording(poses: int, seed: int) -> Recording:
    rng = np.random.default_rng(seed)
    return Recording(WAND, noisy(rig(), wand_markers(poses, rng), rng))


def _by_true_cameras(poses: int = 4000) -> float:
    """RMS error of lengths that cameras without any error measure, from other poses [mm]."""
    rng = np.random.default_rng(99)
    read = noisy(rig(), wand_markers(poses, rng), rng).reshape(-1, 4)
    ends = reconstruct(rig(), read, np.full(4, SIGMA_PX)).position_mm.reshape(-1, 2, 3)
    return float(np.sqrt(np.mean((np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1) - WAND_MM) ** 2)))


@pytest.mark.slow
def test_lengths_held_out_are_as_wrong_as_noise_and_cameras_make_them() -> None:
    recording = _recording(150, 4)
    found = self_calibrate(rig(), [recording])
    held_out = held_out_lengths(found, [recording])
    assert held_out is not None
    assert held_out.poses == held_out.lengths == pytest.approx(150, abs=3)
    bound = _by_true_cameras()
    assert 0.85 * bound < held_out.rms_mm < 1.5 * bound
    assert abs(held_out.mean_mm) < 4.0 * bound / np.sqrt(150)
    assert held_out.rms_mm < held_out.max_mm < 6.0 * held_out.rms_mm


@pytest.mark.slow
def test_few_poses_fit_better_than_they_measure() -> None:
    """What was fitted is too good; what was held out says so."""
    ratio = []
    for seed in range(3):
        recording = _recording(22, seed)
        found = self_calibrate(rig(), [recording])
        held_out = held_out_lengths(found, [recording])
        assert held_out is not None
        fitted = found.targets[0].length_error_mm
        assert fitted is not None
        ratio.append(held_out.rms_mm / fitted)
    assert np.median(ratio) > 1.15


@pytest.mark.slow
def test_a_reading_that_was_rejected_is_not_measured_with() -> None:
    clean = _recording(100, 7)
    readings = clean.readings_px.copy()
    readings[10, 0, 1] += 60.0
    wrong = replace(clean, readings_px=readings)
    found = self_calibrate(rig(), [wrong])
    assert [(one.pose, one.marker) for one in found.rejected][:1] == [(11, 1)]
    held_out = held_out_lengths(found, [wrong])
    without = held_out_lengths(self_calibrate(rig(), [clean]), [clean])
    assert held_out is not None
    assert without is not None
    # The other readings of its marker still measure.
    assert held_out.poses == without.poses
    assert held_out.rms_mm == pytest.approx(without.rms_mm, rel=0.1)


def test_too_few_poses_have_none_to_spare() -> None:
    recording = _recording(100, 8)
    found = self_calibrate(rig(), [recording])
    few = Recording(WAND, recording.readings_px[:8])
    few_found = replace(found, rejected=(), exchanged=())
    assert held_out_lengths(few_found, [few]) is None
