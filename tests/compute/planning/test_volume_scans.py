"""Noiseless scans of a profile's volume, and the errors of peak estimators."""

from dataclasses import replace

import numpy as np
import pytest

from compute.errors import InvalidParameter
from compute.optics.profiles.profile_loader import load_profile
from compute.planning.volume_scans import volume_scans
from compute.signal.centroid_reference import find_peaks_reference
from compute.signal.centroid_settings import CentroidSettings
from compute.signal.peaks import PeakBatch, PeakFlag
from compute.signal.sensor_noise import SensorNoise

LENS = load_profile("thesis-5.9")


def test_true_readings():
    volume = volume_scans(LENS, 3)
    detector = LENS.detector
    assert volume.lines.shape == (27 * 4, LENS.pixels.count)
    counts = volume.lines.astype(float)
    # The even background of a noiseless line is its median.
    light = counts - np.median(counts, axis=1, keepdims=True)
    centre = (light * np.arange(LENS.pixels.count)).sum(axis=1) / light.sum(axis=1)
    inside = (volume.readings_px > 30) & (volume.readings_px < LENS.pixels.count - 30)
    inside &= (counts.max(axis=1) < volume.full_counts).reshape(27, 4)
    assert inside.mean() > 0.8
    # Rounding: the error of each pixel, 0.3 counts, over a few tens of pixels of light.
    assert np.abs(centre.reshape(27, 4) - volume.readings_px)[inside].max() < 0.5
    noise = SensorNoise.of(
        detector.electrons_per_count, detector.read_noise_electrons, detector.offset_counts
    )
    peaks = find_peaks_reference(volume.lines, CentroidSettings(min_width_px=1), noise)
    errors = volume.errors_px(peaks)
    assert np.isfinite(errors).mean() > 0.8
    assert np.sqrt(np.nanmean(errors**2)) < 0.2


def peaks_at(position, amplitude, flags=0):
    batch = PeakBatch.empty(len(position), 2)
    batch.position_px[:] = position
    batch.amplitude[:] = amplitude
    batch.flags[:, 0] = flags
    return batch


def test_errors_are_of_the_brightest():
    volume = volume_scans(LENS, 1)
    true = volume.readings_px.ravel()
    both = np.column_stack([true + 0.25, true + 9.0])
    assert volume.errors_px(peaks_at(both, [5.0, 4.0])) == pytest.approx(0.25)
    assert volume.errors_px(peaks_at(both, [3.0, 4.0])) == pytest.approx(9.0)
    none = np.full_like(both, np.nan)
    assert np.isnan(volume.errors_px(peaks_at(none, np.nan))).all()
    clipped = peaks_at(both, [5.0, 4.0], int(PeakFlag.CLIPPED))
    assert np.isnan(volume.errors_px(clipped)).all()
    assert volume.errors_px(clipped, PeakFlag.UNFITTED) == pytest.approx(0.25)
    unfitted = peaks_at(both, [5.0, 4.0], int(PeakFlag.UNFITTED))
    assert volume.errors_px(unfitted) == pytest.approx(0.25)
    assert np.isnan(volume.errors_px(unfitted, PeakFlag.CLIPPED | PeakFlag.UNFITTED)).all()
    full = replace(volume, full_counts=1)
    assert np.isnan(full.errors_px(peaks_at(both, [5.0, 4.0]))).all()


def test_parts_are_the_whole():
    volume = volume_scans(LENS, 2)
    parts = list(volume.parts(3))
    assert [len(part.readings_px) for part in parts] == [3, 3, 2]
    np.testing.assert_array_equal(np.concatenate([p.lines for p in parts]), volume.lines)
    np.testing.assert_array_equal(
        np.concatenate([p.readings_px for p in parts]), volume.readings_px
    )


def test_pixels_are_as_uneven_as_the_profiles():
    bar = load_profile("bar")
    volume, even = (
        volume_scans(replace(bar, detector=replace(bar.detector, response_nonuniformity=share)), 3)
        for share in (0.01, 0.0)
    )
    light = even.lines - np.median(even.lines, axis=1, keepdims=True)
    bright = (light > 300) & (even.lines < 0.9 * even.full_counts)
    share = (volume.lines[bright].astype(float) - even.lines[bright]) / light[bright]
    # Rounding, at 300 counts and more, is a hundredth of this variance.
    assert share.std() == pytest.approx(0.01, rel=0.01 + 5.0 / np.sqrt(2 * bright.sum()))
    assert abs(share.mean()) < 5.0 * 0.01 / np.sqrt(bright.sum())


def test_refusals():
    for name in ("coda-mpx30", "mitchelson-1971"):
        with pytest.raises(InvalidParameter, match="windows or Gray tracks"):
            volume_scans(load_profile(name))
    with pytest.raises(InvalidParameter, match="per_side is 0"):
        volume_scans(LENS, 0)
