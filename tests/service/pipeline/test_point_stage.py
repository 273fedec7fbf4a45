"""Points of frames by the kernel: those of the reference, through tables, the same every time."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from compute.calibration.calibrate import calibrate
from compute.calibration.result import Calibration, measurement_sigma
from compute.camera.model import SensorModel
from compute.camera.stack import CameraStack
from compute.errors import InvalidParameter
from compute.mapping.grid import VoxelGrid
from compute.mapping.table import CorrectionTable
from compute.measurement.flag_policy import STANDARD_POLICY
from compute.native.native_kernel import native_kernel
from compute.reconstruction.point_batch import PointBatch, PointFlag
from compute.reconstruction.solver import PointSolver
from compute.reconstruction.triangulation import reconstruct
from compute.signal.peaks import PeakBatch, PeakFlag
from hardware.driver import DeviceDescription
from hardware.line_frame import LineFrame
from hardware.simulated.driver import SimulatedDriver
from hardware.simulated.scenes import StillPoints
from hardware.simulated.settings import SimulationSettings
from service.application.initial_content import nominal_calibration
from service.pipeline.active_calibration import ActiveCalibration, PreparedCalibration
from service.pipeline.frame_processor import (
    MAX_SIMULTANEOUS_MARKERS,
    FrameProcessor,
    solve_points,
    weigh_peaks,
)
from tests.compute.rig import control_points, geometry, project, rig

Array = NDArray[np.float64]

SIGMA_PX = 0.02
ROOM = 6


def calibration() -> Calibration:
    models, frame = rig(), control_points(40)
    rng = np.random.default_rng(3)
    readings = project(models, frame) + SIGMA_PX * rng.standard_normal((40, 4))
    return calibrate(frame, readings, geometry(models), np.full((40, 4), SIGMA_PX))


def flat_table(
    shift_px: float, names: tuple[str, ...] = ("s1", "s2", "s3", "s4")
) -> CorrectionTable:
    """The same correction everywhere, in a box about the rig's target."""
    grid = VoxelGrid((-250.0, -250.0, 1250.0), (100.0, 100.0, 100.0), (5, 5, 5))
    return CorrectionTable(
        names,
        "0" * 64,
        grid,
        3,
        np.full((4, 8, 8, 8), shift_px),
        np.full((4, 6, 6, 6), 0.01**2),
        np.ones((4, 5, 5, 5), dtype=np.bool_),
    )


def active_of(table: CorrectionTable | None = None) -> PreparedCalibration:
    known = calibration()
    covariance = None if table is not None else np.array(known.covariance)
    solver = PointSolver(known.models, covariance, table, "cpu")
    return PreparedCalibration("c", known, None if table is None else "t", solver)


def by_reference(active: PreparedCalibration, table: CorrectionTable | None) -> PreparedCalibration:
    """The same, with NumPy in the kernel's place."""
    known = active.calibration
    covariance = None if table is not None else np.array(known.covariance)

    def solve(readings: Array, sigma: Array) -> Any:
        return reconstruct(known.models, readings, sigma, covariance, table)

    return replace(active, solver=SimpleNamespace(solve=solve))


def frames_of(count: int, strobed: bool) -> list[LineFrame]:
    lines = np.zeros((4, 64), np.uint16)
    return [LineFrame("d", n, n, n, 0 if strobed else None, lines) for n in range(count)]


def peaks_of(
    models: tuple[SensorModel, ...], points: list[Array], seed: int = 0, shift_px: float = 0.0
) -> PeakBatch:
    """Noisy peaks of each frame's points, a few missing, in the order of their positions."""
    rng = np.random.default_rng(seed)
    peaks = PeakBatch.empty(len(points) * 4, ROOM)
    for index, those in enumerate(points):
        readings = CameraStack.of(models).project(those) - shift_px
        readings += SIGMA_PX * rng.standard_normal(readings.shape)
        readings[rng.random(readings.shape) < 0.03] = np.nan
        for sensor in range(4):
            seen = np.sort(readings[np.isfinite(readings[:, sensor]), sensor])
            line = index * 4 + sensor
            peaks.count[line] = len(seen)
            peaks.position_px[line, : len(seen)] = seen
            peaks.sigma_px[line, : len(seen)] = SIGMA_PX
            peaks.amplitude[line, : len(seen)] = rng.uniform(100.0, 200.0, len(seen))
    return peaks


def points_of(
    active: PreparedCalibration, frames: list[LineFrame], peaks: PeakBatch
) -> tuple[PointBatch, NDArray[np.intp]]:
    return solve_points(active, frames, weigh_peaks(active, frames, peaks, STANDARD_POLICY))


@pytest.mark.slow
@pytest.mark.parametrize("mapped", [False, True])
@pytest.mark.parametrize(("markers", "strobed"), [(1, True), (1, False), (4, False)])
def test_points_are_those_of_the_reference(markers: int, strobed: bool, mapped: bool) -> None:
    table = flat_table(3.0) if mapped else None
    active = active_of(table)
    points = [control_points(markers, seed=seed) for seed in range(30)]
    peaks = peaks_of(active.calibration.models, points, shift_px=3.0 if mapped else 0.0)
    frames = frames_of(30, strobed)
    found, owner = points_of(active, frames, peaks)
    expected, their_owner = points_of(by_reference(active, table), frames, peaks)
    np.testing.assert_array_equal(owner, their_owner)
    np.testing.assert_array_equal(found.flags, expected.flags)
    np.testing.assert_array_equal(found.used, expected.used)
    np.testing.assert_allclose(found.position_mm, expected.position_mm, rtol=1e-11, atol=1e-8)
    np.testing.assert_allclose(found.covariance_mm2, expected.covariance_mm2, rtol=1e-6)
    # They are the markers, too.
    near = [
        np.abs(points[frame] - place).max(axis=1).min() < 1.0
        for frame, place in zip(owner, found.position_mm, strict=True)
    ]
    assert np.mean(near) > 0.9
    assert len(owner) > 0.8 * 30 * markers


def test_readings_through_a_table_have_their_own_noise() -> None:
    """The calibration's misfit and covariance are not added: the table's variance holds both."""
    table = flat_table(3.0)
    active = active_of(table)
    fits = [replace(fit, chi2_per_dof=100.0) for fit in active.calibration.sensors]
    active = replace(active, calibration=replace(active.calibration, sensors=tuple(fits)))
    models = active.calibration.models
    peaks = peaks_of(models, [control_points(1, seed=2)], shift_px=3.0)
    found, _ = points_of(active, frames_of(1, True), peaks)
    position = peaks.position_px[:, :1].T
    expected = reconstruct(models, position, np.full(4, SIGMA_PX), corrections=table)
    np.testing.assert_allclose(found.covariance_mm2, expected.covariance_mm2, rtol=1e-6)
    wide = measurement_sigma(active.calibration, position, np.full((1, 4), SIGMA_PX))
    assert (wide > 5.0 * SIGMA_PX).all()


def test_points_outside_the_table_are_flagged() -> None:
    active = active_of(flat_table(0.0))
    points = [np.array([[0.0, 0.0, 1500.0]]), np.array([[0.0, 0.0, 1800.0]])]
    peaks = peaks_of(active.calibration.models, points, seed=5)
    found, _ = points_of(active, frames_of(2, True), peaks)
    assert (found.flags & PointFlag.OUTSIDE_MAP > 0).tolist() == [False, True]
    assert (found.flags & PointFlag.NO_COVARIANCE > 0).tolist() == [False, True]
    assert np.isfinite(found.position_mm).all()
    assert np.isnan(found.covariance_mm2[:, 0, 0]).tolist() == [False, True]


def processor() -> tuple[FrameProcessor, list[LineFrame], DeviceDescription]:
    driver = SimulatedDriver("sim", SimulationSettings(duration_s=0.02, realtime=False))
    driver.open()
    frames = list(driver.frames())
    driver.close()
    return FrameProcessor("sim", driver.description, "cpu"), frames, driver.description


def nominal(description: DeviceDescription, shift_mm: float = 0.0) -> Calibration:
    """A calibration of the simulated device's own names; where its markers are is no matter."""
    known = calibration()
    fits = tuple(
        replace(
            fit,
            model=replace(
                fit.model, name=sensor.name, offset_x_mm=fit.model.offset_x_mm + shift_mm
            ),
        )
        for fit, sensor in zip(known.sensors, description.sensors, strict=True)
    )
    return replace(known, sensors=fits)


def test_switches_name_what_is_in_force_and_compile_nothing() -> None:
    made, frames, description = processor()
    names = tuple(sensor.name for sensor in description.sensors)
    before = native_kernel.cache_info().misses
    made.set_calibration(ActiveCalibration("c1", nominal(description)))
    batch = made.process(frames[:1])
    assert (batch.calibration_id, batch.table_id) == made.calibration_ids == ("c1", None)
    made.set_calibration(
        ActiveCalibration("c1", nominal(description), "t1", flat_table(1.0, names))
    )
    batch = made.process(frames[:1])
    assert (batch.calibration_id, batch.table_id) == ("c1", "t1")
    made.set_calibration(ActiveCalibration("c2", nominal(description, 3.0)))
    batch = made.process(frames[:1])
    assert (batch.calibration_id, batch.table_id) == ("c2", None)
    assert native_kernel.cache_info().misses == before
    made.set_calibration(ActiveCalibration())
    assert len(made.process(frames[:1]).points) == 0


def test_a_table_of_other_sensors_leaves_all_as_it_was() -> None:
    made, frames, description = processor()
    made.set_calibration(ActiveCalibration("c1", nominal(description)))
    with pytest.raises(InvalidParameter, match="correction table t1 is of the sensors a, b"):
        made.set_calibration(
            ActiveCalibration(
                "c2", nominal(description), "t1", flat_table(1.0, ("a", "b", "c", "d"))
            )
        )
    assert made.process(frames[:1]).calibration_id == "c1"


def test_frames_give_the_same_bits_again_alone_and_together() -> None:
    made, frames, description = processor()
    other, _, _ = processor()
    known = nominal(description)
    for each in (made, other):
        each.set_calibration(ActiveCalibration("c", known))
    together = made.process(frames).points
    alone = [other.process([frame]).points for frame in frames]
    assert len(together) == len(frames)
    for name in ("position_mm", "covariance_mm2", "chi2", "flags"):
        parts = np.concatenate([getattr(points, name) for points in alone])
        np.testing.assert_array_equal(getattr(together, name), parts)


def test_a_doubtful_peak_concerns_the_points_of_its_own_frame() -> None:
    """Not those of another frame of the batch that reads the very same, nor another sensor's."""
    active = active_of()
    readings = CameraStack.of(active.calibration.models).project(np.array([[0.0, 0.0, 1500.0]]))[0]
    peaks = PeakBatch.empty(8, ROOM)
    peaks.count[:] = 1
    peaks.position_px[:, 0] = np.tile(readings, 2)
    peaks.sigma_px[:, 0], peaks.amplitude[:, 0] = SIGMA_PX, 100.0
    peaks.flags[6, 0] = PeakFlag.SATURATED
    for strobed in (True, False):
        found, owner = points_of(active, frames_of(2, strobed), peaks)
        assert owner.tolist() == [0, 1]
        assert (found.flags & PointFlag.SUSPECT_PEAK > 0).tolist() == [False, True]


@pytest.mark.parametrize(
    ("markers", "found"), [(8, 8), (MAX_SIMULTANEOUS_MARKERS, MAX_SIMULTANEOUS_MARKERS), (14, 0)]
)
def test_markers_lit_together_are_told_apart_up_to_what_time_allows(
    markers: int, found: int
) -> None:
    places = np.random.default_rng(markers).uniform(-150.0, 150.0, (markers, 3))
    places[:, 2] += 1500.0
    scene = StillPoints(tuple(map(tuple, places.tolist())))
    settings = SimulationSettings(
        scene=scene, illumination="simultaneous", realtime=False, duration_s=0.001
    )
    driver = SimulatedDriver("sim", settings)
    driver.open()
    processor = FrameProcessor("sim", driver.description, "cpu")
    processor.set_calibration(ActiveCalibration("nominal", nominal_calibration()))
    batch = processor.process(list(driver.frames()))
    assert len(batch.points) == found
    for place in places if found else ():
        assert np.linalg.norm(batch.points.position_mm - place, axis=1).min() < 1.0


@pytest.mark.parametrize("markers", [1, 2])
def test_a_device_of_three_sensors_says_why_it_finds_no_marker_of_two(markers: int) -> None:
    places = ((-50.0, 20.0, 1500.0), (60.0, -30.0, 1450.0))[:markers]
    settings = SimulationSettings(
        scene=StillPoints(places), illumination="simultaneous", realtime=False, duration_s=0.003
    )
    driver = SimulatedDriver("sim", settings)
    driver.open()
    description = replace(driver.description, sensors=driver.description.sensors[:3])
    nominal = nominal_calibration()
    size = sum(model.parameter_count for model in nominal.models[:3])
    covariance = tuple(row[:size] for row in nominal.covariance[:size])
    known = replace(nominal, sensors=nominal.sensors[:3], covariance=covariance, residuals_px=())
    processor = FrameProcessor("sim", description, "cpu")
    processor.set_calibration(ActiveCalibration("three", known))
    frames = [replace(frame, lines=frame.lines[:3]) for frame in driver.frames()]
    batch = processor.process(frames)
    if markers == 1:
        assert len(batch.points) == len(frames)
        assert processor.remark is None
    else:
        assert len(batch.points) == 0
        assert processor.remark is not None
        assert "add a fourth sensor" in processor.remark


def test_a_wrong_reading_of_a_strobed_marker_is_left_out() -> None:
    """By six sensors; the other readings carry the point."""
    models = rig(6)
    place, count = np.array([[20.0, -30.0, 1480.0]]), 4
    peaks = PeakBatch.empty(6 * count, 1)
    readings = np.repeat(project(models, place), count, axis=0)
    readings += SIGMA_PX * np.random.default_rng(2).standard_normal(readings.shape)
    readings[1, 3] += 5.0
    peaks.count[:], peaks.amplitude[:, 0] = 1, 150.0
    peaks.position_px[:, 0], peaks.sigma_px[:, 0] = readings.ravel(), SIGMA_PX
    frame = control_points(40)
    known = calibrate(frame, project(models, frame), geometry(models), np.full((40, 6), 0.001))
    active = PreparedCalibration("c", known, None, PointSolver(known.models, device="cpu"))
    frames = [replace(one, lines=np.zeros((6, 64), np.uint16)) for one in frames_of(count, True)]
    points, _ = solve_points(active, frames, weigh_peaks(active, frames, peaks, STANDARD_POLICY))
    excluded = points.flags & int(PointFlag.READING_EXCLUDED) != 0
    assert excluded.tolist() == [False, True, False, False]
    assert points.used[1].tolist() == [True, True, True, False, True, True]
    assert np.linalg.norm(points.position_mm - place, axis=1).max() < 0.5
