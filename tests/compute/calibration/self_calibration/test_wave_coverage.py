"""Coverage of a wave as it grows; poses of markers that are lit one after the other."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from compute.calibration.self_calibration.strobed_poses import (
    StrobedPoseCollector,
    StrobedReadings,
)
from compute.calibration.self_calibration.targets import Recording, RigidBody, Wand
from compute.calibration.self_calibration.wave_coverage import (
    MIN_POSES,
    direction_bins,
    wave_coverage,
)
from compute.camera.model import SensorGeometry
from compute.errors import InvalidParameter
from tests.compute.calibration.self_calibration.scenes import MIDDLE, WAND_MM, bars
from tests.compute.rig import project, rig

WAND = Wand((0.0, WAND_MM))
SENSORS = [SensorGeometry(model.name, model.pixels) for model in rig()]


def _collected(
    exposures: StrobedReadings, markers: tuple[int, ...]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    collector = StrobedPoseCollector(markers, (1000,) * 3)
    collector.add(exposures)
    collector.check_lit()
    return collector.poses()


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
        readings, sigma = _collected(exposures, (0, 1))
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
    first = _collected(part, (0, 1))[0][:, 0, 0]
    place = 1500.0 * exposures.time_s
    inside = (first > place[105]) & (first < place[195])
    assert len(first) > 0
    assert not inside.any()


def test_markers_that_were_not_lit_are_refused() -> None:
    exposures, _ = _strobed(0.0)
    with pytest.raises(InvalidParameter, match=r"marker 2 was never lit alone; markers \[0, 1\]"):
        _collected(exposures, (0, 2))
    with pytest.raises(InvalidParameter, match="one twice"):
        _collected(exposures, (1, 1))


def _unit(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))


def test_bins_of_directions_are_equally_large_and_have_no_front() -> None:
    """Points of a spiral that are spread evenly over the sphere fall evenly into the bins."""
    count = 13 * 4000
    z = 1.0 - (2.0 * np.arange(count) + 1.0) / count
    azimuth = np.arange(count) * np.pi * (3.0 - np.sqrt(5.0))
    across = np.sqrt(1.0 - z**2)
    even = np.stack([across * np.cos(azimuth), across * np.sin(azimuth), z], axis=1)
    bins = direction_bins(even)
    assert sum(bins) == count
    assert np.array(bins) == pytest.approx(4000, rel=0.01)
    assert direction_bins(-even) == bins


def test_bins_of_directions_go_from_the_sensors_outwards_and_from_x_to_y() -> None:
    def alone(*direction: float) -> int:
        return direction_bins(_unit(np.array([direction]))).index(1)

    assert alone(0.1, 0.1, 1.0) == alone(-0.1, 0.1, -1.0) == 0
    assert [alone(x, y, 1.5) for x, y in ((1, 1), (-1, 1), (-1, -1), (1, -1))] == [1, 2, 3, 4]
    turns = 2.0 * np.pi * (np.arange(8) + 0.5) / 8
    assert [alone(np.cos(one), np.sin(one), 0.2) for one in turns] == list(range(5, 13))


@pytest.mark.parametrize("seed", range(12))
def test_directions_on_a_cone_are_never_enough(seed: int) -> None:
    """Cones about any axis, also that whose directions have equal components along x, y, z."""
    rng = np.random.default_rng(seed)
    inclination = np.arccos(np.sqrt(1.0 / 3.0)) if seed < 4 else rng.uniform(0.1, 1.57)
    axis = np.eye(3)[2] if seed < 4 else rng.standard_normal(3)
    axis /= np.linalg.norm(axis)
    side = np.cross(axis, np.eye(3)[int(np.argmin(np.abs(axis)))])
    side /= np.linalg.norm(side)
    turns = rng.uniform(0.0, 2.0 * np.pi, (400, 1))
    ring = np.cos(turns) * side + np.sin(turns) * np.cross(axis, side)
    along = np.cos(inclination) * axis + np.sin(inclination) * ring
    middle = MIDDLE + rng.uniform(-450.0, 450.0, (400, 3))
    read = project(rig(), bars(middle, along).reshape(-1, 3)).reshape(400, 2, -1)
    coverage = wave_coverage(SENSORS, Recording(WAND, read), rig())
    assert not coverage.enough
    assert len(coverage.missing) >= 1
    if seed < 4:
        assert "near a cone" in coverage.missing[0]
        assert coverage.directions == pytest.approx((0.58, 0.58, 0.58), abs=0.05)


def test_cells_count_the_readings_in_equal_parts() -> None:
    wave = _wave((1.0, 1.0, 1.0))
    coverage = wave_coverage(SENSORS, wave, rig())
    for column, (sensor, one) in enumerate(zip(SENSORS, coverage.sensors, strict=True)):
        expected = [0] * 10
        for value in wave.readings_px[..., column].ravel().tolist():
            if not np.isnan(value):
                expected[int((value + 0.5) * 10 / sensor.pixels)] += 1
        assert list(one.cells) == expected
        assert one.readings == sum(expected)


def test_a_body_is_judged_by_the_lines_between_its_markers() -> None:
    """Three markers in a plane that never tilts have no line towards the sensors."""
    rng = np.random.default_rng(2)
    shape = np.array([[0.0, 0.0, 0.0], [120.0, 0.0, 0.0], [30.0, 90.0, 0.0]])
    body = RigidBody(tuple(tuple(one) for one in shape.tolist()))
    turns = rng.uniform(0.0, 2.0 * np.pi, 150)
    rotation = np.zeros((150, 3, 3))
    rotation[:, 0, 0] = rotation[:, 1, 1] = np.cos(turns)
    rotation[:, 1, 0] = np.sin(turns)
    rotation[:, 0, 1] = -rotation[:, 1, 0]
    rotation[:, 2, 2] = 1.0
    middle = MIDDLE + rng.uniform(-450.0, 450.0, (150, 3))
    markers = np.einsum("bij,kj->bki", rotation, shape) + middle[:, None]
    read = project(rig(), markers.reshape(-1, 3)).reshape(150, 3, -1)
    coverage = wave_coverage(SENSORS, Recording(body, read), rig())
    assert coverage.poses == 150
    assert coverage.directions is not None
    assert coverage.direction_bins is not None
    assert sum(coverage.direction_bins) == 3 * 150
    assert coverage.directions[2] < 0.05
    assert any("towards the sensors" in one for one in coverage.missing)
    assert any("a body" in one for one in wave_coverage(SENSORS, Recording(body, read)).missing)


@pytest.mark.parametrize("seed", range(6))
def test_exposures_in_any_parts_give_the_same_poses(seed: int) -> None:
    """However many exposures come at a time, also fewer than a strobe cycle; none comes twice."""
    rng = np.random.default_rng(seed)
    exposures, _ = _strobed(2000.0)
    # As slow as a device can be: the target moves on by more than a pose in a cycle.
    exposures = replace(exposures, readings_px=exposures.readings_px * (1.0 + 4.0 * (seed % 2)))
    whole = _collected(exposures, (0, 1))[0]
    collector = StrobedPoseCollector((0, 1), (1000,) * 3)
    cuts = np.sort(rng.choice(np.arange(1, 400), int(rng.integers(5, 200)), replace=False))
    for part in np.split(np.arange(400), cuts):
        collector.add(exposures.select(np.isin(np.arange(400), part)))
    assert np.array_equal(collector.poses()[0], whole)
    assert collector.counts.all == 200
    assert collector.counts.taken == len(whole)


def test_exposures_that_make_no_pose_are_counted() -> None:
    exposures, _ = _strobed(0.0)
    readings = exposures.readings_px.copy()
    readings[100:200] = readings[100]  # it rests
    readings[200:300, 0] = np.nan  # two sensors are not enough
    lost = (exposures.marker == 1) & (exposures.time_s > 0.6)
    part = replace(exposures, readings_px=readings).select(~lost)
    collector = StrobedPoseCollector((0, 1), (1000,) * 3)
    collector.add(part)
    counts = collector.counts
    assert counts.still >= 49
    assert counts.too_few_sensors >= 49
    assert counts.not_lit >= 48
    assert counts.all == counts.taken + counts.still + counts.too_few_sensors + counts.not_lit


def test_a_device_that_begins_anew_goes_on() -> None:
    exposures, _ = _strobed(0.0)
    collector = StrobedPoseCollector((0, 1), (1000,) * 3)
    collector.add(exposures)
    once = len(collector)
    collector.add(replace(exposures, readings_px=exposures.readings_px[::-1]))
    assert len(collector) == pytest.approx(2 * once, abs=1)
