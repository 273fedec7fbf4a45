"""Accuracy budgets beside the published accuracies of Table 1.1."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.optics.profiles.device_profile import DeviceProfile
from compute.optics.profiles.profile_loader import (
    load_profile,
    profile_names,
    with_error_sources,
)
from compute.optics.profiles.profile_sections import PublishedFigure
from compute.planning.coverage import Box
from compute.planning.plan import plan
from compute.planning.plan_result import AccuracyBudget, Plan
from validation.result_tables import Cell, ResultTable, TablesCase
from validation.table_1_1.case import along

Array = NDArray[np.float64]

GRID: Final = 5
FACTOR: Final = 3.0
"""A budget within this factor of the published figure agrees with it."""

STEP_WIDTH: Final = float(np.sqrt(12.0))
"""Width of the rectangular distribution with a standard uncertainty of 1 (GUM, 4.3.7)."""

COVERAGE_FACTOR: Final = 2.0
"""Of an expanded uncertainty, beside the largest of some dozen errors."""

NOT_COMPARED: Final[Mapping[str, str]] = {
    "thesis-5.1": "its figures are of simulated rays, without noise, warmth or real markers",
    "thesis-5.2": "its figures are of generated readings, without errors but rounding",
}

HEADINGS: Final = (
    "device", "figure", "axis", "place", "published", "budget", "ratio", "dominant",
)  # fmt: skip


@cache
def planned(name: str, distance_mm: float) -> tuple[Plan, AccuracyBudget]:
    """Return the plan of still markers in a profile's volume moved to a distance [mm]."""
    profile = with_error_sources(load_profile(name), ["speed=0 mm/s"])
    x, y, _ = profile.volume.centre_mm
    box = Box((x, y, distance_mm), profile.volume.size_mm)
    found = plan(profile, grid=GRID, markers=1, volume=box)
    assert found.budget is not None, found.notes
    return found, found.budget


def meaning(profile: DeviceProfile, figure: PublishedFigure) -> str:
    """Return what a figure is: Table 1.1 prints as resolutions what elsewhere are errors."""
    if figure.quantity == "resolution":
        for other in profile.published:
            if other.quantity != "resolution" and other.value_mm == figure.value_mm:
                return other.quantity
    return figure.quantity


def predicted(profile: DeviceProfile, figure: PublishedFigure) -> tuple[str, float, str]:
    """Return where the budget is taken, its value [mm], and its dominant contribution.

    An accuracy: the RMS in the plane at the figure's distance, or over the volume where it names
    none. A largest error: twice the standard uncertainty at the worst place. A resolution: the
    width of the random part in the centre. For all axes ("3d"): the largest of them.

    Args:
        profile: the device.
        figure: one of its published figures.
    """
    distance = figure.distance_mm or profile.volume.centre_mm[2]
    found, budget = planned(profile.name, distance)
    quantity = meaning(profile, figure)
    if quantity == "resolution":
        centre = budget.random.centre
        assert centre is not None
        chosen = [one for one in budget.contributions if one.kind == "random" and one.counted]
        dominant = max(chosen, key=lambda one: one.rms_mm).name
        return "centre", STEP_WIDTH * _axis(np.array(centre), figure), dominant
    if quantity == "max error":
        assert budget.total.worst is not None
        worst = np.array(budget.total.worst)
        return "worst", COVERAGE_FACTOR * _axis(worst, figure), budget.dominant
    positions = [
        point.uncertainty_mm
        for point in found.points
        if point.uncertainty_mm is not None
        and (figure.distance_mm is None or np.isclose(point.position_mm[2], distance))
    ]
    rms = np.sqrt(np.square(positions).mean(axis=0))
    position = "volume" if figure.distance_mm is None else f"z = {distance:g}"
    return position, _axis(rms, figure), budget.dominant


def _axis(values: Array, figure: PublishedFigure) -> float:
    if figure.axis == "3d":
        return float(values.max())
    x, y, z = values.tolist()
    found = along((x, y, z), figure.axis)
    assert found is not None
    return found


def rows(name: str) -> list[tuple[Cell, ...]]:
    """Return a row for each published figure of a device, once where two sources print it."""
    profile = load_profile(name)
    found: dict[tuple[str, str, float], tuple[Cell, ...]] = {}
    for figure in profile.published:
        position, value, dominant = predicted(profile, figure)
        found[meaning(profile, figure), figure.axis, figure.value_mm] = (
            name, meaning(profile, figure), figure.axis, position, figure.value_mm, value,
            figure.value_mm / value, dominant,
        )  # fmt: skip
    return list(found.values())


def agrees(row: Sequence[Cell]) -> bool:
    """Return whether a row's budget is within FACTOR of the published figure."""
    ratio = row[HEADINGS.index("ratio")]
    assert isinstance(ratio, float)
    return 1.0 / FACTOR <= ratio <= FACTOR


def reason(row: Sequence[Cell]) -> str:
    """Return by how much a row's figure and budget differ, and why."""
    name, quantity, axis, _, value, budget, ratio, _ = row
    profile = load_profile(str(name))
    [figure, *_] = [
        one
        for one in profile.published
        if (meaning(profile, one), one.axis, one.value_mm) == (quantity, axis, value)
    ]
    why = REASONS.get(profile.name)
    return (
        f"{name}, {quantity} {axis} {value:g} mm: {ratio:.2g} times the budget ({budget:.2g}). "
        f"{'No reason is known.' if why is None else why(profile, figure)}"
    )


def contribution_table(names: Sequence[str]) -> ResultTable:
    """Return the 3D RMS of each contribution over each device's volume [mm]."""
    budgets = [planned(name, load_profile(name).volume.centre_mm[2])[1] for name in names]
    headings = ("contribution", *names)
    table: list[tuple[Cell, ...]] = [
        (one.name, *(budget.contributions[number].rms_mm for budget in budgets))
        for number, one in enumerate(budgets[0].contributions)
    ]
    table.append(("total", *(budget.total_rms_mm for budget in budgets)))
    return ResultTable("contributions, 3D RMS over the volume, mm", headings, tuple(table))


def compute_tables(
    names: Sequence[str] | None = None,
) -> tuple[tuple[ResultTable, ...], tuple[str, ...]]:
    """Return the tables and the findings, of all profiles or of some."""
    chosen = [name for name in (names or profile_names()) if name not in NOT_COMPARED]
    with_figures = [name for name in chosen if load_profile(name).published]
    found = [row for name in with_figures for row in rows(name)]
    table = ResultTable("published figures and accuracy budgets, mm", HEADINGS, tuple(found))
    good = [row for row in found if agrees(row)]
    findings = [
        f"{len(good)} of {len(found)} figures are within a factor of {FACTOR:g} of the budget."
    ]
    findings += [reason(row) for row in found if not agrees(row)]
    findings += [f"{name} is not compared: {why}." for name, why in NOT_COMPARED.items()]
    silent = [name for name in chosen if not load_profile(name).published]
    if silent:
        findings.append(f"No accuracy was published of {', '.join(silent)}.")
    return (table, contribution_table(with_figures)), (*_NOTES, *findings)


def _leo(profile: DeviceProfile, figure: PublishedFigure) -> str:
    lateral = predicted(profile, replace(figure, axis="lateral"))[1]
    return (
        "The source names no axis, so that the largest, the depth, is compared; across, where a "
        f"whole pixel makes {lateral:.2g} mm, the figure is {figure.value_mm / lateral:.2g} times "
        "the budget."
    )


def _thesis_5_9(profile: DeviceProfile, figure: PublishedFigure) -> str:
    axis = "xyz".index(figure.axis)
    ratio = METRIC_MM[axis] / predicted(profile, figure)[1]
    return (
        "No row of Table 1.1. The published figures are those of DLT with a wrong label; the same "
        f"readings, calibrated with seven parameters and labels repaired (case test-5.4), leave "
        f"{METRIC_MM[axis]:g} mm, {ratio:.2g} times the budget."
    )


METRIC_MM: Final = (0.929, 0.995, 3.52)
"""Mean absolute errors of test-5.4, metric with labels repaired, which that case prints."""

REASONS: Final[Mapping[str, Callable[[DeviceProfile, PublishedFigure], str]]] = {
    "leo-macellari-1981": _leo,
    "thesis-5.9": _thesis_5_9,
}
"""Why figures of a device lie outside."""

_NOTES: Final = (
    (
        "The budgets are of still markers; what no source says of a device is assumed alike for "
        "all (lumiline plan NAME prints it), and so are most lenses, detectors and LEDs: agreement "
        "within a factor shows that a budget is of the right size, and proves no single line of it."
    ),
    (
        "An accuracy stands beside the RMS of the standard uncertainties in the plane at its "
        "distance, or over the volume where no distance is said; a largest error beside twice the "
        "standard uncertainty at the worst place; a resolution beside the width of the random part "
        "in the centre, sqrt(12) times its standard uncertainty, so that rounding counts as one "
        "whole step. A figure for all axes, or of none that is named, stands beside the largest. "
        "What Table 1.1 calls a resolution, and another place, with the same value, an error, is "
        "compared as that error."
    ),
)

CASE: Final = TablesCase(
    "accuracy-budget",
    "accuracy budget of every device of Table 1.1 beside its published accuracy",
    "Table 1.1, sections 2.3, 2.4 and 7.2.3, appendix G",
    compute_tables,
)
