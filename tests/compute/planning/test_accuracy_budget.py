"""Accuracy budget: each contribution against geometry of its own, and their sum."""

from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from compute.calibration.calibrate import calibrate
from compute.calibration.settings import CalibrationSettings
from compute.camera.model import SensorGeometry
from compute.camera.stack import CameraStack
from compute.errors import InvalidParameter, NoConvergence
from compute.optics.profiles.device_profile import DeviceProfile
from compute.optics.profiles.error_sources import ErrorSources
from compute.optics.profiles.profile_loader import load_profile, with_error_sources
from compute.optics.profiles.profile_sections import RetroMarkers
from compute.planning.budget_inputs import BudgetInputs
from compute.planning.coverage import Box
from compute.planning.error_contributions import (
    ErrorContribution,
    PlannedScene,
    error_contributions,
)
from compute.planning.plan import plan
from compute.planning.plan_result import AccuracyBudget, BudgetContribution, Plan
from tests.compute.rig import camera
from tests.oracles.ideal_sensors import IdealSensor, aimed_sensor, locate

OPTOTRAK = load_profile("optotrak")
TARGET = np.array([0.0, 0.0, 1500.0])
POSITIONS = np.array([[-350.0, 0.0, 0.0], [-100.0, 0.0, 0.0], [150.0, 0.0, 0.0], [300.0, 0.0, 0.0]])
ANGLES = (0.0, np.pi / 2, np.pi / 4, 0.1)
SIGMA = np.array([0.05, 0.1, 0.02, 0.07])
POINTS = np.array([[0.0, 0.0, 1500.0], [180.0, -120.0, 1300.0], [-60.0, 210.0, 1750.0]])
SENSORS = [
    aimed_sensor(position, TARGET, angle) for position, angle in zip(POSITIONS, ANGLES, strict=True)
]


def scene(
    sources: ErrorSources,
    radius: float | None = None,
    lens: Callable[[IdealSensor, np.ndarray], np.ndarray] = IdealSensor.read,
) -> PlannedScene:
    """Four ideal sensors on a bar, or with lenses of their own, as a plan sees them."""
    models = [
        camera(f"s{i}", position, angle, TARGET)
        for i, (position, angle) in enumerate(zip(POSITIONS, ANGLES, strict=True))
    ]
    cameras = CameraStack.of(models)
    readings, gradient = cameras.linearise(POINTS)
    ours = np.array([one.read(POINTS) for one in SENSORS]).T
    np.testing.assert_allclose(readings, ours, atol=1e-6)
    shape = readings.shape
    device: Any = SimpleNamespace(
        names=tuple(model.name for model in models),
        pixels=2048,
        positions_mm=POSITIONS,
        quantisation_px=None,
        image_points=lambda points: SimpleNamespace(
            readings_px=np.array([lens(one, points) for one in SENSORS]).T,
            light_sr=np.ones((len(points), 4)),
        ),
    )
    lines: Any = SimpleNamespace(
        cameras=cameras,
        readings_px=np.array([lens(one, POINTS) for one in SENSORS]).T,
        gradient_px_per_mm=gradient,
        bound_px=np.broadcast_to(SIGMA, shape),
        pattern_px=np.full(shape, 0.01),
    )
    inputs = BudgetInputs.of(replace(OPTOTRAK, error_sources=sources))
    box = Box((0.0, 0.0, 1500.0), (500.0, 500.0, 500.0))
    return PlannedScene(device, lines, box, POINTS, np.zeros_like(POINTS), radius, inputs)


def contribution(name: str, sources: ErrorSources, radius: float | None = None) -> np.ndarray:
    found = {one.name: one for one in error_contributions(scene(sources, radius))}
    return found[name].sigma_mm


def located_error(changed: list[IdealSensor]) -> np.ndarray:
    """Errors of points located by the original sensors from readings of changed ones."""
    readings = np.array([one.read(POINTS) for one in changed]).T
    return locate(SENSORS, readings, SIGMA, POINTS) - POINTS


def test_warming_is_that_of_sensors_which_moved_apart() -> None:
    sources = ErrorSources(
        expansion_per_k=20e-6, focus_expansion_per_k=-8e-6, temperature_change_k=3.0
    )
    away = POSITIONS - POSITIONS.mean(axis=0)
    warm = [
        one.moved(60e-6 * shift, np.zeros(3), -24e-6)
        for one, shift in zip(SENSORS, away, strict=True)
    ]
    error = np.abs(located_error(warm))
    assert error.max() > 0.05
    np.testing.assert_allclose(contribution("warming", sources), error, rtol=0.01, atol=2e-4)


def test_bending_is_that_of_sensors_on_an_arc() -> None:
    curvature = 23.6e-6 * 0.5 / 80.0
    along = (POSITIONS - POSITIONS.mean(axis=0))[:, 0]
    # The arc of a circle through the middle of the bar, its ends towards the scene.
    angle = curvature * along
    arc = np.column_stack(
        [np.sin(angle) / curvature - along, np.zeros(4), (1.0 - np.cos(angle)) / curvature]
    )
    bent = [
        one.moved(shift, np.array([0.0, -turn, 0.0]))
        for one, shift, turn in zip(SENSORS, arc, angle, strict=True)
    ]
    error = np.abs(located_error(bent))
    sources = ErrorSources(expansion_per_k=23.6e-6, bar_gradient_k=0.5, bar_depth_mm=80.0)
    assert error.max() > 0.1
    found = contribution("bending of the bar", sources)
    np.testing.assert_allclose(found, error, rtol=0.01, atol=1e-3)


def test_a_marker_moves_with_its_tilt_in_any_direction() -> None:
    depth, tilt = 0.2, np.radians(40.0)
    found = contribution(
        "marker", ErrorSources(optical_centre_depth_mm=depth, marker_tilt_rad=float(tilt))
    )
    middle = POSITIONS.mean(axis=0)
    for point, sigma in zip(POINTS, found, strict=True):
        back = (point - middle) / np.linalg.norm(point - middle)
        side = np.cross(back, [0.0, 1.0, 0.0])
        side /= np.linalg.norm(side)
        up = np.cross(back, side)
        azimuth = np.linspace(0.0, 2.0 * np.pi, 360, endpoint=False)[:, None]
        round_it = np.cos(azimuth) * side + np.sin(azimuth) * up
        moved = depth * (np.cos(tilt) * back + np.sin(tilt) * round_it) - depth * back
        np.testing.assert_allclose(sigma, np.sqrt(np.square(moved).mean(axis=0)), rtol=1e-9)


def test_a_tilted_discs_image_is_off_the_image_of_its_centre() -> None:
    radius, tilt = 20.0, np.radians(35.0)
    sources = ErrorSources(optical_centre_depth_mm=0.0, marker_tilt_rad=float(tilt))
    found = contribution("marker", sources, radius)[0]
    # The rim at the near and the far side; a camera in front at the mean position of the sensors.
    distance = np.linalg.norm(POINTS[0] - POSITIONS.mean(axis=0))
    rim = [
        side * radius * np.cos(tilt) / (distance + side * radius * np.sin(tilt))
        for side in (-1.0, 1.0)
    ]
    shift = abs(sum(rim)) / 2.0 * distance
    assert shift > 0.1
    assert np.hypot(*found[:2]) == pytest.approx(shift, rel=0.01)


@pytest.mark.slow
def test_calibrations_with_uncertain_control_points_scatter_as_budgeted() -> None:
    rng = np.random.default_rng(8)
    control, trials, sigma_mm = 25, 120, 0.3
    # Points spread as evenly, but not those of the budget.
    grid = np.stack(np.meshgrid(*[np.linspace(-0.5, 0.5, 4)] * 3), axis=-1).reshape(-1, 3)
    errors = []
    for _ in range(trials):
        # A random part of a grid in cells, so that no placement is favoured.
        cells = grid[rng.permutation(len(grid))[:control]]
        share = np.clip(cells * 0.75 + rng.uniform(-0.125, 0.125, cells.shape), -0.5, 0.5)
        points = TARGET + 500.0 * share
        readings = np.array([one.read(points) for one in SENSORS]).T
        given = points + sigma_mm * rng.standard_normal(points.shape)
        readings += SIGMA * rng.standard_normal(readings.shape)
        found = calibrate(
            given,
            readings,
            [SensorGeometry(f"s{i}", 2048) for i in range(4)],
            np.broadcast_to(SIGMA, readings.shape),
            CalibrationSettings(position_sigma_mm=sigma_mm),
        )
        cameras = CameraStack.of(found.models)
        shifted = cameras.project(POINTS)
        truth = np.array([one.read(POINTS) for one in SENSORS]).T
        # Located by the true sensors from what the calibrated ones would read: the error's sign
        # turns round, its size stays.
        errors.append(locate(SENSORS, 2.0 * truth - shifted, SIGMA, POINTS) - POINTS)
    rms = np.sqrt(np.square(errors).mean(axis=0))
    sources = ErrorSources(
        control_points=control, control_position_sigma_mm=sigma_mm, distortion="uncorrected"
    )
    budgeted = contribution("calibration", sources)
    # 120 trials scatter by 6 %; another placement of 25 points does more.
    np.testing.assert_allclose(budgeted, rms, rtol=0.35)
    assert np.exp(np.log(budgeted / rms).mean()) == pytest.approx(1.0, abs=0.15)


def test_terms_leave_what_they_cannot_fit() -> None:
    """Distortion of the third order is fitted away; a wave along the row is not."""

    def error(wave_px: float) -> np.ndarray:
        def lens(sensor: IdealSensor, points: np.ndarray) -> np.ndarray:
            u = (sensor.read(points) - sensor.middle_px) / sensor.distance_px
            wave = wave_px * np.sin(2.0 * np.pi * u / 0.05)
            return sensor.read(points) + 0.5 * sensor.distance_px * u**3 + wave

        sources = ErrorSources(
            terms_residual_px=0.0, control_points=300, control_position_sigma_mm=0.0
        )
        found = {one.name: one for one in error_contributions(scene(sources, lens=lens))}
        return found["distortion after terms"].sigma_mm

    assert error(0.0).max() < 1e-4
    # With so many control points the fit goes through the middle of the wave.
    wave = np.array(
        [0.2 * np.sin(2.0 * np.pi * (one.read(POINTS) - 1023.5) / 3000.0 / 0.05) for one in SENSORS]
    ).T
    readings = np.array([one.read(POINTS) for one in SENSORS]).T
    expected = np.abs(locate(SENSORS, readings - wave, SIGMA, POINTS) - POINTS)
    found = error(0.2)
    assert expected.max() > 0.05
    np.testing.assert_allclose(found, expected, atol=0.3 * expected.max())


def test_more_and_better_control_points_calibrate_better() -> None:
    few, many, exact = (
        contribution(
            "calibration", ErrorSources(control_points=count, control_position_sigma_mm=sigma)
        )
        for count, sigma in ((30, 0.1), (480, 0.1), (30, 0.0))
    )
    ratio = few / many
    assert ((ratio > 2.0) & (ratio < 10.0)).all()
    assert (exact < few).all()


@pytest.fixture(scope="module")
def usual_plan() -> Plan:
    return plan(OPTOTRAK, grid=3, markers=1)


@pytest.fixture(scope="module")
def usual(usual_plan: Plan) -> AccuracyBudget:
    assert usual_plan.budget is not None
    return usual_plan.budget


def budget_of(profile: DeviceProfile) -> AccuracyBudget:
    found = plan(profile, grid=3, markers=1).budget
    assert found is not None
    return found


def listed(budget: AccuracyBudget) -> dict[str, BudgetContribution]:
    return {one.name: one for one in budget.contributions}


def test_the_total_is_the_root_of_the_sum_of_squares(usual: AccuracyBudget) -> None:
    counted = [one for one in usual.contributions if one.counted]
    assert usual.total_rms_mm**2 == pytest.approx(sum(one.rms_mm**2 for one in counted))
    assert sum(one.share for one in usual.contributions) == pytest.approx(1.0)
    assert listed(usual)[usual.dominant].share == max(one.share for one in counted)
    for number, distance in enumerate(usual.distances_mm):
        assert distance in (1850.0, 2250.0, 2650.0)
        squares = sum(one.by_distance_mm[number] ** 2 for one in counted)
        assert usual.total_by_distance_mm[number] ** 2 == pytest.approx(squares)


def test_noise_and_fixed_pattern_are_the_plans(usual_plan: Plan, usual: AccuracyBudget) -> None:
    by_name = listed(usual)
    for summary, name in (
        (usual_plan.noise, "noise"),
        (usual_plan.fixed_pattern, "fixed pattern"),
    ):
        assert by_name[name].sigma.worst == pytest.approx(summary.worst, rel=1e-9)


def test_a_flat_field_replaces_the_pattern(usual: AccuracyBudget) -> None:
    sources = ["pixels=flat-fielded", "flat_field_residual=0.25"]
    flat = listed(budget_of(with_error_sources(OPTOTRAK, sources)))
    assert not flat["fixed pattern"].counted
    assert flat["fixed pattern, flat-fielded"].counted
    before = listed(usual)["fixed pattern"]
    assert before.counted
    assert flat["fixed pattern, flat-fielded"].rms_mm == pytest.approx(0.25 * before.rms_mm)


def test_rounding_to_a_pixel_and_timing() -> None:
    """Three sensors: weights do not matter, and the geometry's share says it all."""
    sources = ["reading_step=1 px", "timing=1 ms", "speed=20 m/s"]
    found = plan(with_error_sources(OPTOTRAK, sources), grid=3, markers=1)
    assert found.budget is not None
    by_name = listed(found.budget)
    assert found.dilution.centre is not None
    expected = np.array(found.dilution.centre) / np.sqrt(12.0)
    assert by_name["rounding of readings"].sigma.centre == pytest.approx(tuple(expected), rel=1e-6)
    assert by_name["timing"].rms_mm == pytest.approx(20.0)
    assert not by_name["timing"].assumed
    assert found.budget.dominant == "timing"


def test_what_is_given_is_not_called_assumed(usual: AccuracyBudget) -> None:
    by_name = {one.name: one for one in usual.inputs}
    assert not by_name["distortion"].assumed
    assert by_name["temperature_change"].assumed
    assert by_name["temperature_change"].unit == "K"
    assert "6061" in by_name["expansion"].source
    given = budget_of(with_error_sources(OPTOTRAK, ["temperature_change=2 K"]))
    [same] = [one for one in given.inputs if one.name == "temperature_change"]
    assert not same.assumed
    # The same value: only the word differs.
    assert given.total == usual.total
    doubtful = replace(
        with_error_sources(OPTOTRAK, ["temperature_change=2 K"]),
        assumed={"error_sources.temperature_change": "as in our room"},
    )
    [one] = [one for one in BudgetInputs.of(doubtful).by_field.values() if one.value == 2.0]
    assert one.assumed
    assert one.source == "as in our room"


def test_uncorrected_distortion_may_be_given_or_traced(usual: AccuracyBudget) -> None:
    given = with_error_sources(
        OPTOTRAK, ["distortion=uncorrected", 'uncorrected_distortion=["1 px", "1 px", "1 px"]']
    )
    found = plan(given, grid=3, markers=1)
    assert found.budget is not None
    one = listed(found.budget)["distortion, uncorrected"]
    assert one.sigma.centre == pytest.approx(found.dilution.centre, rel=1e-6)
    assert one.counted
    assert not listed(usual)["distortion, uncorrected"].counted
    with pytest.raises(InvalidParameter, match="has 2 values; give one for each of the 3 sensors"):
        with_error_sources(OPTOTRAK, ['uncorrected_distortion=["1 px", "2 px"]'])


@pytest.mark.slow
def test_retro_reflective_markers_have_a_size() -> None:
    values = {
        "illuminator_intensity_w_per_sr": 1.0,
        "illuminator_position_mm": (0.0, 0.0, 0.0),
        "wavelength_nm": 880.0,
        "spectral_width_nm": 50.0,
        "retroreflection_per_sr": 300.0,
        "observation_half_angle_rad": 0.2,
        "half_angle_rad": 0.7,
        "max_markers": 4,
    }
    small, large = (
        listed(budget_of(replace(OPTOTRAK, markers=RetroMarkers(diameter_mm=size, **values))))  # type: ignore[arg-type]
        for size in (5.0, 50.0)
    )
    assert small["marker"].rms_mm < large["marker"].rms_mm


def test_without_a_calibration_there_is_no_budget_and_the_plan_says_why(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def fail(*_: object, **__: object) -> None:
        raise NoConvergence("sensor left found no camera")

    monkeypatch.setattr("compute.planning.error_contributions.calibrate", fail)
    found = plan(OPTOTRAK, grid=3, markers=1)
    assert found.budget is None
    assert found.noise.centre is not None
    assert found.points[0].uncertainty_mm is None
    assert any("sensor left found no camera" in note for note in found.notes)


@pytest.mark.parametrize(
    ("assignment", "words"),
    [
        ("speed", 'must be written as "speed=200 mm/s"'),
        ("sped=1 mm/s", "there is no such field; there are pixels"),
        ("speed=3", 'has no unit; give a speed such as "100 mm/s"'),
        ("speed=-1 mm/s", "must be zero or positive"),
        ("temperature_change=2 mm", "is no difference of temperatures"),
        ("control_points=3", "must be 14 to 1000"),
        ("flat_field_residual=1.5", "must be 0 to 1"),
        ("distortion=maps", 'is not one of "uncorrected", "terms", "map"'),
        ("marker_tilt=95 deg", "must be below pi/2"),
        ("bar_depth=0 mm", "must be positive"),
        ('uncorrected_distortion=["-1 px", "1 px", "1 px"]', "0 or more, for each sensor"),
    ],
)
def test_what_is_refused(assignment: str, words: str) -> None:
    with pytest.raises(InvalidParameter) as error:
        with_error_sources(OPTOTRAK, [assignment])
    assert words in error.value.detail


def test_contributions_are_nowhere_negative_and_nan_only_without_a_position() -> None:
    found: tuple[ErrorContribution, ...] = error_contributions(scene(ErrorSources()))
    assert all((one.sigma_mm >= 0.0).all() for one in found)
    lost = scene(ErrorSources())
    lost.lines.gradient_px_per_mm[1, :2] = np.nan
    for one in error_contributions(lost):
        known = np.isfinite(one.sigma_mm).all(axis=1)
        if one.name != "distortion, uncorrected":
            assert known.tolist() == [True, False, True]
