"""Plan: a device's coverage and precision over its working volume, from its profile."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.camera.model import vector3
from compute.errors import (
    DegeneratePoints,
    NoConvergence,
    TooFewPoints,
    UndeterminedParameters,
)
from compute.optics.profiles.device_profile import DeviceProfile
from compute.optics.profiles.profile_sections import RetroMarkers
from compute.parameter_checks import require
from compute.planning.accuracy_budget import accuracy_budget, combined_sigma
from compute.planning.budget_inputs import BudgetInputs
from compute.planning.coverage import Box, Coverage, coverage, volume_grid
from compute.planning.data_rates import Rates, rates
from compute.planning.error_contributions import PlannedScene, error_contributions
from compute.planning.ghost_points import (
    MAX_SENSORS,
    GhostCount,
    ghost_probabilities,
    intersecting_points,
)
from compute.planning.plan_result import (
    AccuracyBudget,
    AxisSummary,
    Plan,
    PlannedPoint,
    PlannedSensor,
    finite_vector,
)
from compute.planning.planning_device import PlanningDevice, planning_device
from compute.planning.precision import precision_from_jacobian, propagated_sigma, reading_gain
from compute.planning.simulated_readings import Progress, SimulatedReadings, simulate_readings
from compute.reconstruction.triangulation import reconstruct

Array = NDArray[np.float64]

MAX_MARKERS: Final = 64
"""Markers up to which ghosts are listed."""

_LISTED_COUNTS: Final = (2, 3, 4, 5, 6, 8, 10, 12, 16, 20, 24, 28, 32, 40, 50, 64)
_MIN_COMMON_COVERAGE: Final = 0.1
"""Smallest share of the volume that all sensors see, for ghosts to be counted."""


def plan(
    profile: DeviceProfile,
    *,
    grid: int | tuple[int, int, int] = 5,
    markers: int | None = None,
    volume: Box | None = None,
    ghost_trials: int = 5000,
    seed: int = 0,
    progress: Progress | None = None,
) -> Plan:
    """Compute a device's coverage, precision, accuracy budget, rates and ghost points.

    Args:
        profile: the device.
        grid: points along the axes of the volume, at least 3 each and 100,000 in all; odd numbers
            hold the middle.
        markers: largest number of markers to list; None: as many as the device drives, up to 64.
        volume: where; None: the profile's working volume.
        ghost_trials: of the Monte Carlo, for each way to mix markers.
        seed: of its random numbers.
        progress: called with the fraction done, 0 to 1.

    Raises:
        InvalidParameter: a value out of its range; a volume that is not seen well enough.
    """
    most = min(profile.markers.max_markers, MAX_MARKERS) if markers is None else markers
    require(1 <= most <= MAX_MARKERS, f"be 1 to {MAX_MARKERS}", markers=most)
    box = volume or Box(profile.volume.centre_mm, profile.volume.size_mm)
    shape = (grid, grid, grid) if isinstance(grid, int) else grid
    require(min(shape) >= 3, "have at least 3 points along each axis", grid=grid)
    require(ghost_trials >= 1, "be at least 1", ghost_trials=ghost_trials)
    volume_points = volume_grid(box, shape)
    device = planning_device(profile)
    report = progress or (lambda _: None)
    lines = simulate_readings(device, volume_points.points_mm, report)

    gradients = lines.gradient_px_per_mm
    noise = precision_from_jacobian(gradients, lines.bound_px)
    centroid = precision_from_jacobian(gradients, lines.centroid_px)
    dilution = precision_from_jacobian(gradients, np.ones(len(device.names)))
    pattern_mm = propagated_sigma(reading_gain(gradients, lines.bound_px), lines.pattern_px)
    distortion = _distortion(lines, volume_points.points_mm)
    centre = int(np.linalg.norm(volume_points.points_mm - box.centre_mm, axis=1).argmin())
    radius = profile.markers.diameter_mm / 2 if isinstance(profile.markers, RetroMarkers) else None
    inputs = BudgetInputs.of(profile)
    scene = PlannedScene(device, lines, box, volume_points.points_mm, distortion, radius, inputs)
    budget, total, reason = _budget(scene, centre)
    seen_by = coverage(lines.visible, volume_points.weights)
    ghosts, notes = _ghosts(device, lines, box, seen_by, most, ghost_trials, seed)
    if len(device.names) == 3 and most > 1:
        notes = (*notes, _THREE_SENSORS)
    report(1.0)
    return Plan(
        profile.name,
        profile.title,
        box,
        shape,
        _sensors(device, lines),
        AxisSummary.of(noise.sd_mm, centre),
        AxisSummary.of(centroid.sd_mm, centre),
        AxisSummary.of(dilution.sd_mm, centre),
        AxisSummary.of(pattern_mm, centre),
        AxisSummary.of(np.abs(distortion), centre),
        budget,
        seen_by,
        _rates(profile, most),
        tuple(intersecting_points(count) for count in _listed(most)),
        ghosts,
        tuple(
            PlannedPoint(vector3(point), int(count), int(full), *map(finite_vector, figures))
            for point, count, full, *figures in zip(
                volume_points.points_mm,
                lines.visible.sum(axis=1),
                lines.saturated.sum(axis=1),
                noise.sd_mm,
                centroid.sd_mm,
                dilution.sd_mm,
                pattern_mm,
                distortion,
                total,
                strict=True,
            )
        ),
        (_ASSUMPTIONS, *reason, *_saturation_notes(lines), *notes),
    )


def _budget(
    scene: PlannedScene, centre: int
) -> tuple[AccuracyBudget | None, Array, tuple[str, ...]]:
    """Return the accuracy budget, the points' uncertainties (N, 3) [mm], and why there is none."""
    try:
        contributions = error_contributions(scene)
    except (TooFewPoints, UndeterminedParameters, DegeneratePoints, NoConvergence) as error:
        reason = (
            "There is no accuracy budget, because its control points do not calibrate the "
            f"sensors: {error.detail}. Give more control points, or another volume."
        )
        return None, np.full(scene.points_mm.shape, np.nan), (reason,)
    budget = accuracy_budget(contributions, scene.inputs, scene.points_mm[:, 2], centre)
    return budget, combined_sigma(contributions), ()


def _distortion(lines: SimulatedReadings, points: Array) -> Array:
    """Return the errors of points that perspective cameras make of exact readings, (N, 3)."""
    sigma = np.maximum(lines.misfit_px, 1e-9)
    return reconstruct(lines.cameras, lines.readings_px, sigma).position_mm - points


def _ghosts(
    device: PlanningDevice,
    lines: SimulatedReadings,
    box: Box,
    seen_by: Coverage,
    most: int,
    trials: int,
    seed: int,
) -> tuple[tuple[GhostCount, ...], tuple[str, ...]]:
    """Return the expected ghosts, and notes on how they were computed or why not."""
    if most < 2:
        return (), ()
    if not 3 <= len(device.names) <= MAX_SENSORS:
        return (), (f"Ghosts are counted for 3 to {MAX_SENSORS} sensors.",)
    if seen_by.all_sensors < _MIN_COMMON_COVERAGE:
        share = 100 * seen_by.all_sensors
        return (), (f"Ghosts are not counted: all sensors see only {share:.0f} % of the volume.",)
    sigma = np.where(np.isfinite(lines.centroid_px), lines.centroid_px, lines.bound_px)
    probabilities = ghost_probabilities(
        lines.cameras,
        device.pixels,
        box,
        column_medians(sigma),
        drawn_from=box,
        trials=trials,
        seed=seed,
    )
    note = (
        f"Ghosts: {trials} combinations of each way to mix markers were tried, of markers in the "
        f"{100 * probabilities.visible_fraction:.0f} % of the volume that all sensors see."
    )
    return tuple(probabilities.expected(count) for count in _listed(most)), (note,)


def _listed(most: int) -> tuple[int, ...]:
    return tuple(sorted({*(count for count in _LISTED_COUNTS if count < most), most} - {1}))


def _rates(profile: DeviceProfile, most: int) -> tuple[Rates, ...]:
    return tuple(
        rates(
            count,
            profile.rates.line_rate_hz,
            profile.markers.illumination,
            sensors=len(profile.sensors),
            pixels=profile.pixels.count,
            bits=profile.detector.bits,
        )
        for count in sorted({1, most})
    )


def _sensors(device: PlanningDevice, lines: SimulatedReadings) -> tuple[PlannedSensor, ...]:
    medians = {
        "scan_electrons": column_medians(lines.scan_electrons),
        "peak_electrons": column_medians(lines.peak_electrons),
        "bound_px": column_medians(lines.bound_px),
        "centroid_px": column_medians(lines.centroid_px),
        "fixed_pattern_px": column_medians(lines.pattern_px),
    }
    share = lines.saturated.sum(axis=0) / np.maximum(lines.visible.sum(axis=0), 1)
    return tuple(
        PlannedSensor(
            name=name,
            position_mm=vector3(device.positions_mm[sensor]),
            saturated=float(share[sensor]),
            misfit_px=float(lines.misfit_px[sensor]),
            principal_distance_px=float(lines.cameras.principal_distance_px[sensor]),
            **{
                key: float(values[sensor]) if np.isfinite(values[sensor]) else None
                for key, values in medians.items()
            },
        )
        for sensor, name in enumerate(device.names)
    )


def _saturation_notes(lines: SimulatedReadings) -> tuple[str, ...]:
    """Return notes on saturated stripes."""
    if not lines.saturated.any():
        return ()
    share = 100 * lines.saturated.sum() / lines.visible.sum()
    note = (
        f"{share:.2g} % of the lines are saturated, with ambient light and dark signal: their "
        "noise and fixed pattern are given as if they were not cut, which is too good."
    )
    return (note,)


def column_medians(values: Array) -> Array:
    """Return the medians of the columns, shape (N, S) -> (S,); NaN for one without values."""
    finite = [column[np.isfinite(column)] for column in values.T]
    return np.array([np.median(column) if len(column) else np.nan for column in finite])


_ASSUMPTIONS: Final = (
    "Standard deviations of the noise are of one exposure of a device calibrated without error, "
    "its distortion corrected. The fixed pattern is that of pixels that are not flat-fielded; it "
    "comes on top, the same in every exposure. Markers face every sensor."
)

_THREE_SENSORS: Final = (
    "With three sensors two or more markers lit together are not found: each of the N^3 "
    "combinations of their readings is a point. No track and no tool begins; strobe them, or add "
    "a fourth sensor."
)
