"""Plans of the built-in profiles, and of devices made to have known answers."""

import json
from dataclasses import asdict, replace

import numpy as np
import pytest

from compute.camera.model import Vector3
from compute.errors import InvalidParameter
from compute.optics.profiles.device_profile import DeviceProfile, PlateOptics, SensorProfile
from compute.optics.profiles.profile_loader import load_profile
from compute.optics.profiles.profile_sections import RetroMarkers
from compute.planning.coverage import Box, is_visible
from compute.planning.plan import plan
from compute.planning.plan_result import AxisSummary
from compute.planning.planning_device import planning_device

BAR = load_profile("bar")
TOLD: list[float] = []
PLAN = plan(BAR, grid=3, markers=4, ghost_trials=200, progress=TOLD.append)


def array(values: Vector3 | None) -> np.ndarray:
    assert values is not None
    return np.array(values)


def test_a_plan_is_json() -> None:
    text = json.dumps(asdict(PLAN), allow_nan=False)
    assert json.loads(text)["profile_id"] == "bar"


def test_the_bar() -> None:
    assert PLAN.grid == (3, 3, 3)
    assert len(PLAN.points) == 27
    assert [sensor.name for sensor in PLAN.sensors] == [sensor.name for sensor in BAR.sensors]
    assert PLAN.coverage.three_or_more == pytest.approx(1.0)
    # A sensor far from the middle of a bar: depth is the worst axis, by the ratio of distance
    # to baseline, 1500 mm to 2 x 291 mm at most.
    for summary in (PLAN.noise, PLAN.centroid):
        x, y, z = array(summary.centre)
        assert 1500.0 / 582.0 < z / x < 10.0
        assert 1500.0 / 582.0 < z / y < 10.0
        assert (array(summary.best) <= array(summary.median)).all()
        assert (array(summary.median) <= array(summary.worst)).all()
    # No finder is better than the bound.
    assert (array(PLAN.centroid.centre) > array(PLAN.noise.centre)).all()
    for sensor in PLAN.sensors:
        assert sensor.bound_px is not None
        assert sensor.centroid_px is not None
        assert sensor.bound_px < sensor.centroid_px < 0.1
        # 35.58 mm less the lens's front half, in pixels of 12 um.
        assert 2500.0 < sensor.principal_distance_px < 2965.0
        assert sensor.saturated == 0.0


def test_the_summary_is_of_the_points() -> None:
    sd = np.array([point.sd_mm for point in PLAN.points])
    assert PLAN.noise.worst == pytest.approx(tuple(sd.max(axis=0)))
    [centre] = [point for point in PLAN.points if point.position_mm == BAR.volume.centre_mm]
    assert PLAN.noise.centre == centre.sd_mm
    assert {point.sensors for point in PLAN.points} == {4}


def test_rates_and_ghosts_are_listed_up_to_the_markers() -> None:
    assert [one.markers for one in PLAN.rates] == [1, 4]
    assert [one.markers for one in PLAN.ghosts] == [2, 3, 4]
    assert PLAN.planar_intersections == (8, 21, 40)
    assert [one.candidates for one in PLAN.ghosts] == [16, 81, 256]


def test_more_light_less_noise_and_one_marker_no_ghosts() -> None:
    """Four times the light: photon noise halves, and read noise falls still faster."""
    bright = replace(
        BAR,
        markers=replace(
            BAR.markers,
            radiant_intensity_w_per_sr=4.0 * BAR.markers.radiant_intensity_w_per_sr,  # type: ignore[union-attr]
        ),
    )
    alone = plan(bright, grid=3, markers=1)
    assert alone.ghosts == ()
    assert [one.markers for one in alone.rates] == [1]
    ratio = array(PLAN.noise.centre) / array(alone.noise.centre)
    assert (ratio > 2.0).all()
    assert (ratio < 4.0).all()


def moved(profile: DeviceProfile, factor: float) -> DeviceProfile:
    """The device with a baseline times as long, aimed straight ahead."""

    def place(sensor: SensorProfile) -> SensorProfile:
        x, y, z = (factor * np.array(sensor.position_mm)).tolist()
        return replace(sensor, position_mm=(x, y, z), aim_mm=(x, y, z + 1000.0))

    return replace(profile, sensors=tuple(place(sensor) for sensor in profile.sensors))


def depth(profile: DeviceProfile, distance_mm: float) -> tuple[float, float]:
    """SD of the depth straight ahead [mm]: for readings of 1 px, and by the light."""
    found = plan(
        profile, grid=3, markers=1, volume=Box((0.0, 0.0, distance_mm), (600.0, 600.0, 600.0))
    )
    return float(array(found.dilution.centre)[2]), float(array(found.noise.centre)[2])


def exponent(x: list[float], y: list[float]) -> float:
    return float(np.log(y[1] / y[0]) / np.log(x[1] / x[0]))


@pytest.mark.slow
def test_depth_error_goes_with_distance_squared_over_baseline() -> None:
    """The four-sensor bar with its real lens, from 2.5 to 6 m and with 0.3 to 1 of its baseline.

    This is for readings that are as good everywhere. The light falls, too, and leaves the focus:
    the depth's noise grows faster than with the square.
    """
    near, far = depth(moved(BAR, 1.0), 2500.0), depth(moved(BAR, 1.0), 6000.0)
    assert exponent([2500.0, 6000.0], [near[0], far[0]]) == pytest.approx(2.0, abs=0.1)
    assert 3.0 < exponent([2500.0, 6000.0], [near[1], far[1]]) < 4.5
    short = depth(moved(BAR, 0.3), 6000.0)
    for figure in range(2):
        assert exponent([0.3, 1.0], [short[figure], far[figure]]) == pytest.approx(-1.0, abs=0.1)


def test_a_well_that_ambient_light_fills_is_saturated() -> None:
    """The signal of the brightest pixels has room, but not beside the ambient light."""
    device = planning_device(BAR)
    peaks = [sensor.peak_electrons for sensor in PLAN.sensors]
    assert all(peak is not None and peak < 0.5 * device.full_electrons for peak in peaks)
    assert not any(point.saturated for point in PLAN.points)
    light = 0.9 * device.full_electrons / BAR.rates.exposure_s
    bright = replace(BAR, detector=replace(BAR.detector, ambient_electrons_per_s=light))
    found = plan(bright, grid=3, markers=1)
    assert [sensor.peak_electrons for sensor in found.sensors] == peaks
    assert all(sensor.saturated > 0.5 for sensor in found.sensors)
    assert any(point.saturated == 4 for point in found.points)
    mean = np.mean([point.saturated for point in found.points])
    assert mean == pytest.approx(sum(sensor.saturated for sensor in found.sensors))
    assert any("lines are saturated" in note for note in found.notes)
    assert not any("saturated" in note for note in PLAN.notes)
    # The detector counts no more from there on.
    detector = replace(
        bright.detector.detector(bright.rates.exposure_s),
        response_nonuniformity=0.0,
        dark_nonuniformity=0.0,
    )
    room = device.full_electrons - detector.ambient_electrons - detector.dark_electrons
    signal = np.repeat(room + np.array([[-1e4], [-5e3], [5e3], [1e4]]), 2000, axis=1)
    counts = detector.expose(signal, np.random.default_rng(1)).mean(axis=1)
    gained = np.diff(counts) * detector.electrons_per_count
    assert gained[0] == pytest.approx(5e3, abs=100.0)
    assert gained[2] == pytest.approx(0.0, abs=100.0)


@pytest.mark.slow
def test_coded_windows_and_plates_are_planned_too() -> None:
    coda = plan(load_profile("coda-mpx30"), grid=3, markers=1)
    assert coda.coverage.all_sensors > 0.9
    assert coda.centroid == AxisSummary(None, None, None, None)
    assert all(sensor.centroid_px is None for sensor in coda.sensors)
    assert all(sensor.fixed_pattern_px for sensor in coda.sensors)
    # A window of plane faces: next to no distortion.
    assert all(sensor.misfit_px < 0.01 for sensor in coda.sensors)
    plate = load_profile("mitchelson-1971")
    found = plan(plate, grid=3, markers=1)
    [optics] = plate.optics.values()
    assert isinstance(optics, PlateOptics)
    assert all(sensor.bound_px == pytest.approx(12.0**-0.5) for sensor in found.sensors)
    assert all(sensor.fixed_pattern_px is None for sensor in found.sensors)
    assert found.fixed_pattern == AxisSummary(None, None, None, None)
    # 12 bits over 10 mm.
    assert planning_device(plate).pixels == 4096


@pytest.mark.slow
def test_what_no_three_sensors_see_has_no_position() -> None:
    """A volume far wider than the field of view."""
    box = Box((0.0, 0.0, 1500.0), (2000.0, 600.0, 600.0))
    wide = plan(BAR, grid=(5, 3, 3), markers=2, volume=box)
    assert 0.0 < wide.coverage.three_or_more < 1.0
    dark = [point for point in wide.points if point.sensors < 3]
    assert dark
    assert all(point.sd_mm is None and point.distortion_mm is None for point in dark)
    assert all(point.fixed_pattern_mm is None for point in dark)
    assert all(point.sd_mm is not None for point in wide.points if point.sensors >= 3)
    # What a sensor does not see is not in its medians.
    device = planning_device(BAR)
    points = np.array([point.position_mm for point in wide.points])
    look = device.image_points(points)
    electrons = look.light_sr * device.electrons_per_sr(points)
    visible = is_visible(look.readings_px, device.pixels, look.light_sr)
    assert not visible.all()
    for number, sensor in enumerate(wide.sensors):
        median = np.median(electrons[visible[:, number], number])
        assert sensor.scan_electrons == pytest.approx(median)


def test_light_of_the_markers_makes_electrons() -> None:
    """I t lambda / (h c) photons per steradian, times the quantum efficiency."""
    device = planning_device(BAR)
    [[electrons, *_], *_] = device.electrons_per_sr(np.array([[0.0, 0.0, 1500.0]]))
    photon_j = 6.62607015e-34 * 299792458.0 / 880e-9
    assert electrons == pytest.approx(25e-3 * 100e-6 / photon_j * 0.5)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"grid": 2}, "grid is 2"),
        ({"grid": (3, 3, 1)}, "grid is"),
        ({"grid": 47}, "grid is"),
        ({"markers": 0}, "markers is 0"),
        ({"markers": 65}, "markers is 65"),
        ({"volume": Box((0.0, 0.0, -1500.0), (600.0, 600.0, 600.0))}, "not seen well enough"),
        ({"volume": Box((9000.0, 0.0, 1500.0), (600.0, 600.0, 600.0))}, "not seen well enough"),
        ({"ghost_trials": 0}, "trials is 0"),
    ],
)
def test_what_is_refused(arguments: dict[str, object], message: str) -> None:
    with pytest.raises(InvalidParameter, match=message):
        plan(BAR, **({"grid": 3} | arguments))  # type: ignore[arg-type]


def test_optics_of_two_kinds_are_refused() -> None:
    window = load_profile("coda-mpx30").optics["main"]
    first, *rest = BAR.sensors
    mixed = replace(
        BAR,
        sensors=(replace(first, optics="other"), *rest),
        optics={**BAR.optics, "other": window},
    )
    with pytest.raises(InvalidParameter, match="2 kinds"):
        plan(mixed, grid=3)


def test_passive_markers_are_lit_from_the_device() -> None:
    """1/r^2 on the way there, times what is sent back at these angles; the way back, the lens's
    solid angle, is not in it."""
    passive = replace(
        BAR,
        markers=RetroMarkers(
            10.0, (0.0, 0.0, 0.0), 880.0, 50.0, 500.0, np.radians(10.0), np.radians(30.0), 10.0, 4
        ),
    )
    device = planning_device(passive)
    points = np.array([[0.0, 0.0, 1500.0], [0.0, 0.0, 3000.0]])
    near, far = device.electrons_per_sr(points)
    angle = np.arctan2(np.linalg.norm(device.positions_mm, axis=1), np.array([[1500.0], [3000.0]]))
    left = np.exp2(-((angle / np.radians(10.0)) ** 2))
    # Facing a sensor, the disc is oblique to the lamp: at 30 deg half is left, cosine and all.
    rest = 0.5 / np.cos(np.radians(30.0))
    left *= rest ** ((angle / np.radians(30.0)) ** 2) * np.cos(angle)
    np.testing.assert_allclose(near / far, 4.0 * left[0] / left[1], rtol=1e-6)


def test_progress_is_told() -> None:
    assert sorted(TOLD) == TOLD
    assert TOLD[-1] == 1.0
    assert 0.0 < TOLD[0] < 1.0
