"""Coverage of a wave as it grows; poses of markers that are lit one after the other."""

import numpy as np
import pytest
from numpy.typing import NDArray

from compute.calibration.self_calibration.strobed_poses import StrobedReadings, strobed_poses
from compute.calibration.self_calibration.targets import Recording, Wand
from compute.calibration.self_calibration.wave_coverage import MIN_POSES, wave_coverage
from compute.camera.model import SensorGeometry
from compute.errors import InvalidParameter
from tests.compute.calibration.self_calibration.scenes import MIDDLE, WAND_MM, bars
from tests.compute.rig import project, rig

WAND = Wand((0.0, WAND_MM))
SENSORS = [SensorGeometry(model.name, model.pixels) for model in rig()]


def _wave(axes: tuple[float, ...], side_mm: float = 900.0, poses: int = 160) -> Recording:
    rng = np.random.default_rng(3)
    middles = rng.uniform(-0.5, 0.5, (poses, 3)) * side_mm
    markers = bars(MIDDLE + middles, rng.standard_normal((poses, 3)) * axes)
    read = project(rig(), markers.reshape(-1, 3)).reshape(poses, 2, -1)
    inside = (read >= 0.0) & (read <= rig()[0].pixels - 1.0)
    return Recording(WAND, np.where(inside, read, np.nan))


def test_a_wave_all_over_is_enough() -> None:
    coverage = wave_coverage(SENSORS, _wave((1.0, 1.0, 1.0)), rig())
    assert coverage.missing == ()
    assert coverage.enough
    assert coverage.directions == pytest.approx((0.58, 0.58, 0.58), abs=0.1)


def test_a_wave_grows_until_it_is_enough() -> None:
    whole = _wave((1.0, 1.0, 1.0)).readings_px
    left = []
    for count in (10, 60, 160):
        coverage = wave_coverage(SENSORS, Recording(WAND, whole[:count]), rig())
        left.append(MIN_POSES - coverage.poses)
        assert any("more poses" in one for one in coverage.missing) == (left[-1] > 0)
    assert left[0] > left[1] > 0 >= left[2]
    assert (
        "directions and volume" in wave_coverage(SENSORS, Recording(WAND, whole)).missing[0].lower()
    )


# The pixels of the rig's first sensor lie along the world's y.
@pytest.mark.parametrize(("axis", "name"), [(0, "y"), (1, "x"), (2, "z")])
def test_directions_that_are_missing_are_named(axis: int, name: str) -> None:
    weights = [1.0, 1.0, 1.0]
    weights[axis] = 0.1
    missing = wave_coverage(SENSORS, _wave((*weights,)), rig()).missing
    assert len(missing) == 1
    assert f"along {name} (" in missing[0]


def test_pixels_that_saw_nothing_are_named() -> None:
    wave = _wave((1.0, 1.0, 1.0))
    wave.readings_px[..., 2][wave.readings_px[..., 2] < 0.45 * SENSORS[2].pixels] = np.nan
    missing = wave_coverage(SENSORS, wave, rig()).missing
    limit = 0.4 * SENSORS[2].pixels
    assert any(
        f"{SENSORS[2].name} saw next to nothing below pixel {limit:.0f}" in one for one in missing
    )
    wave.readings_px[..., 2] = np.nan
    assert f"Sensor {SENSORS[2].name} saw nothing." in wave_coverage(SENSORS, wave).missing


def _strobed(acceleration_mm_s2: float) -> tuple[StrobedReadings, NDArray[np.float64]]:
    """Two markers in turn, 2 ms apart, on a line along which they accelerate; readings in mm."""
    time = 0.002 * np.arange(400, dtype=np.float64)
    place = 1500.0 * time + 0.5 * acceleration_mm_s2 * time**2
    marker = np.arange(400) % 2
    readings = np.stack(
        [place + 100.0 * marker, 2.0 * place + 70.0 * marker, 500.0 - place], axis=1
    )
    exact = np.stack(
        [
            np.stack([place + 100.0 * m, 2.0 * place + 70.0 * m, 500.0 - place], axis=1)
            for m in (0, 1)
        ],
        axis=1,
    )
    return StrobedReadings(time, marker, readings, np.full(readings.shape, 0.1)), exact


def test_strobed_markers_are_brought_to_one_instant() -> None:
    for acceleration in (0.0, 2000.0):
        exposures, exact = _strobed(acceleration)
        readings, sigma = strobed_poses(exposures, (0, 1), (1000, 1000, 1000))
        assert 20 < len(readings) < 200
        error = np.abs(readings[:, None] - exact[None]).max(axis=(2, 3)).min(axis=1)
        assert error.max() <= 1e-9 + acceleration * 0.002**2  # twice a/8 of the square of 4 ms
        assert np.median(sigma[:, 1]) == pytest.approx(0.1 / np.sqrt(2.0), rel=0.01)


def test_gaps_are_not_interpolated() -> None:
    exposures, _ = _strobed(0.0)
    kept = (exposures.marker == 0) | (exposures.time_s < 0.2) | (exposures.time_s > 0.4)
    part = StrobedReadings(
        exposures.time_s[kept], exposures.marker[kept],
        exposures.readings_px[kept], exposures.sigma_px[kept],
    )  # fmt: skip
    first = strobed_poses(part, (0, 1), (1000,) * 3)[0][:, 0, 0]
    place = 1500.0 * exposures.time_s
    inside = (first > place[105]) & (first < place[195])
    assert len(first) > 0
    assert not inside.any()


def test_markers_that_were_not_lit_are_refused() -> None:
    exposures, _ = _strobed(0.0)
    with pytest.raises(InvalidParameter, match=r"marker 2 was never lit alone; markers \[0, 1\]"):
        strobed_poses(exposures, (0, 2), (1000,) * 3)
    with pytest.raises(InvalidParameter, match="one twice"):
        strobed_poses(exposures, (1, 1), (1000,) * 3)
