"""Settings, noise and peaks as values: ranges, messages, and imports that stay light."""

import subprocess
import sys

import numpy as np
import pytest

from compute.errors import InvalidParameter
from compute.flags import flag_names
from compute.signal.centroid_reference import find_peaks_reference
from compute.signal.centroid_settings import CentroidSettings, sample_starts
from compute.signal.peaks import Peak, PeakFlag
from compute.signal.sensor_noise import SensorNoise
from tests.compute.signal.synthetic_scans import NOISE, gaussian_counts, measured


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("threshold_fraction", 0.0),
        ("threshold_fraction", 1.0),
        ("threshold_fraction", float("nan")),
        ("detection_sigma", 2.9),
        ("detection_sigma", float("inf")),
        ("detection_sigma", float("nan")),
        ("min_width_px", 0),
        ("weighting", "heavy"),
        ("max_peaks", 0),
        ("max_peaks", 1025),
    ],
)
def test_settings_out_of_range_are_refused_by_name_and_value(field, value):
    with pytest.raises(InvalidParameter, match=f"{field} is .*{value}") as caught:
        CentroidSettings(**{field: value})
    assert caught.value.context.keys() == {field}


@pytest.mark.parametrize(
    ("field", "value", "words"),
    [
        ("electrons_per_count", 0.0, "electrons_per_count of sensor 0 is 0.0"),
        ("electrons_per_count", [1.0, float("inf")], "sensor 1 is inf"),
        ("read_noise_electrons", [1.0, -1.0], "read_noise_electrons of sensor 1 is -1.0"),
        ("read_noise_electrons", float("nan"), "is nan"),
        ("offset_counts", 1e6, "offset_counts"),
        ("full_scale_counts", 65536, "full_scale_counts"),
        ("full_scale_counts", 0, "full_scale_counts"),
        ("offset_counts", [], "shapes"),
        ("offset_counts", [[1.0, 2.0]], "shapes"),
    ],
)
def test_noise_out_of_range_is_refused_by_name_and_value(field, value, words):
    good = {"electrons_per_count": 10.0, "read_noise_electrons": 20.0}
    with pytest.raises(InvalidParameter, match=words):
        SensorNoise.of(**(good | {field: value}))


def test_noise_arrays_must_agree_in_length():
    with pytest.raises(InvalidParameter, match=r"\(2,\).*\(3,\)"):
        SensorNoise.of([1.0, 2.0], [1.0, 2.0, 3.0])


def test_noise_of_one_number_serves_all_sensors():
    noise = SensorNoise.of([10.0, 20.0], 40.0, 0.0, 255)
    assert len(noise) == 2
    np.testing.assert_allclose(noise.dark_variance, [16 + 1 / 12, 4 + 1 / 12])
    np.testing.assert_allclose(noise.photon_variance, [0.1, 0.05])
    assert noise.full_scale_counts.tolist() == [255, 255]


@pytest.mark.parametrize("pixels", [64, 65, 127, 263, 2048, 16384, 65536])
def test_the_background_is_taken_from_the_whole_line(pixels):
    starts = sample_starts(pixels)
    assert len(starts) == min(32, pixels // 8)
    assert starts[0] == 0
    assert pixels - 2 * pixels // len(starts) - 8 <= starts[-1] <= pixels - 8
    assert (np.diff(starts) >= 8).all()
    assert all(start % 8 == 0 for start in starts)


def test_a_line_as_values():
    counts = gaussian_counts(256, [60.0, 180.0], 2.0, 500.0).sum(axis=0, keepdims=True)
    batch = find_peaks_reference(
        measured(counts, np.random.default_rng(0), full=400), CentroidSettings(), NOISE
    )
    peaks = batch.peaks(0)
    assert len(batch) == 1
    assert [type(peak) for peak in peaks] == [Peak, Peak]
    assert peaks[1].position_px == batch.position_px[0, 1]
    assert peaks[1].flags == ()


def test_flags_by_name():
    assert flag_names(PeakFlag.NONE) == ()
    assert flag_names(PeakFlag.SATURATED | PeakFlag.MERGED) == ("saturated", "merged")


@pytest.mark.slow
def test_types_and_settings_load_no_warp():
    code = (
        "import sys, compute.signal, compute.signal.peaks, compute.signal.centroid_settings, "
        "compute.signal.sensor_noise, compute.signal.centroid_reference, "
        "compute.signal.centroid_finder; "
        "sys.exit('warp' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0
