"""Table 1.1: published resolution and accuracy of every device profile beside predictions."""

from collections.abc import Mapping, Sequence
from functools import cache
from typing import Final

import numpy as np

from compute.camera.model import Vector3
from compute.optics.profiles.device_profile import DeviceProfile
from compute.optics.profiles.profile_loader import load_profile, profile_names
from compute.optics.profiles.profile_sections import Axis, PublishedFigure
from compute.planning.coverage import Box
from compute.planning.plan import plan
from compute.planning.plan_result import AxisSummary, Plan
from validation.result_tables import Cell, ResultTable, TablesCase
from validation.table_1_1.remarks import remark

GRID: Final = 3
LIKE: Final = 1.25
"""Figures that differ by a smaller factor are called of one size."""

HEADINGS: Final = (
    "device", "figure", "axis", "at, mm", "published", "bound", "c.o.g.", "pattern", "half px",
    "distortion", "worst",
)  # fmt: skip

COMPARED: Final[Mapping[str, tuple[str, ...]]] = {
    "resolution": ("bound", "c.o.g.", "half px"),
    "accuracy": ("bound", "c.o.g.", "pattern", "half px", "distortion"),
    "max error": ("bound", "c.o.g.", "pattern", "half px", "worst"),
}
"""What a published figure is compared with: a resolution not with errors that stand still, a
mean error with the median distortion, a largest one with the largest."""

ABSENT: Final[Mapping[str, tuple[str, ...]]] = {
    "thesis-5.1": ("bound", "c.o.g.", "pattern"),
    "thesis-5.2": ("bound", "c.o.g.", "pattern", "distortion", "worst"),
}
"""What simulated readings do not have, and are not compared with."""

WORDS: Final[Mapping[str, str]] = {
    "bound": "the noise at its bound",
    "c.o.g.": "the noise by centre of gravity",
    "pattern": "the fixed pattern",
    "half px": "half a pixel in every reading",
    "distortion": "the median distortion",
    "worst": "the worst distortion",
}


@cache
def planned(name: str, distance_mm: float) -> Plan:
    """Return the plan of a profile, its volume moved to a distance [mm]."""
    profile = load_profile(name)
    x, y, _ = profile.volume.centre_mm
    box = Box((x, y, distance_mm), profile.volume.size_mm)
    return plan(profile, grid=GRID, markers=1, volume=box)


def along(values: Vector3 | None, axis: Axis) -> float | None:
    """Return a figure along a published axis [mm]; "lateral" is the larger of X and Y.

    Raises:
        ValueError: "3d", which is no one axis.
    """
    if axis == "3d":
        raise ValueError("3d is not one axis; compare lateral and depth")
    if values is None:
        return None
    x, y, z = values
    return {"x": x, "y": y, "z": z, "depth": z, "lateral": max(x, y)}[axis]


def row(profile: DeviceProfile, figure: PublishedFigure | None, axis: Axis) -> tuple[Cell, ...]:
    """Return a row of the table: a published figure (or none) and what is predicted there."""
    distance = profile.volume.centre_mm[2]
    if figure is not None and figure.distance_mm is not None:
        distance = figure.distance_mm
    found = planned(profile.name, distance)
    # The largest error is that of the worst place.
    largest = figure is not None and figure.quantity == "max error"

    def at(summary: AxisSummary) -> float | None:
        centre = summary.centre or summary.median
        return along(summary.worst if largest else centre, axis)

    pixel = at(found.dilution)
    return (
        profile.name,
        "none" if figure is None else figure.quantity,
        axis,
        distance,
        None if figure is None else figure.value_mm,
        at(found.noise),
        at(found.centroid),
        at(found.fixed_pattern),
        None if pixel is None else 0.5 * pixel,
        along(found.distortion.median, axis),
        along(found.distortion.worst, axis),
    )


def rows(name: str) -> list[tuple[Cell, ...]]:
    """Return the rows of a profile: of each published figure, or of none.

    A figure without an axis, or for all, has two: it stands beside what is predicted laterally
    and in depth.
    """
    profile = load_profile(name)
    figures: Sequence[PublishedFigure | None] = profile.published or (None,)
    return [
        row(profile, figure, axis)
        for figure in figures
        for axis in (_BOTH if figure is None or figure.axis == "3d" else (figure.axis,))
    ]


_BOTH: Final[tuple[Axis, ...]] = ("lateral", "depth")


def finding(name: str, found: Sequence[tuple[Cell, ...]], more: str = "") -> str:
    """Say how the published figures of a device lie to the predicted ones.

    Args:
        name: of the device.
        found: its rows.
        more: what else belongs to them.
    """
    parts = []
    for cells in found:
        known = dict(zip(HEADINGS, cells, strict=True))
        published, quantity = known["published"], str(known["figure"])
        if isinstance(published, float):
            compared = [one for one in COMPARED[quantity] if one not in ABSENT.get(name, ())]
            position = _place(published, known, compared)
            parts.append(f"{quantity} {known['axis']} {published:g} mm {position}")
    return f"{name}: {'; '.join(parts) or 'no figure was published'}. {more}".strip()


def _place(published: float, row: Mapping[str, Cell], compared: Sequence[str]) -> str:
    """Say between which predicted figures a published one lies, and of whose size it is."""
    known = sorted((value, name) for name in compared if isinstance(value := row[name], float))
    if not known:
        return "beside no prediction"
    descriptions = [f"{WORDS[name]} ({value:.2g})" for value, name in known]
    like = [abs(np.log(published / value)) < np.log(LIKE) for value, _ in known]
    if any(like):
        same = [words for words, is_like in zip(descriptions, like, strict=True) if is_like]
        return f"is of the size of {' and of '.join(same)}"
    above = sum(value < published for value, _ in known)
    if above == 0:
        return f"is {published / known[0][0]:.2g} times the least compared, {descriptions[0]}"
    if above == len(known):
        return f"is {published / known[-1][0]:.2g} times the largest compared, {descriptions[-1]}"
    return f"lies between {descriptions[above - 1]} and {descriptions[above]}"


_NOTES: Final = (
    (
        "Predicted from the profiles, whose lenses, stops and markers are mostly assumed: orders "
        "of magnitude, not digits. A figure that is of the size of another is not explained by "
        "it. bound, c.o.g.: standard deviation of one exposure, readings at the Cramer-Rao bound "
        "or by centre of gravity. pattern: standard deviation of the error by pixels that are not "
        "flat-fielded. half px: an error of half a pixel (or of half a step of a Gray plate) in "
        "every reading. All four are of the middle of the volume, beside largest errors of its "
        f"worst of {GRID**3} points."
    ),
    (
        "distortion, worst: what perspective cameras calibrated in the volume leave of the lenses' "
        "distortion, median and largest of the points, without correction. Lateral is the "
        "larger of X and Y. A figure whose axis is not said, or that is for all, stands beside "
        "lateral and depth. A resolution is compared with noise and half a pixel, a mean error "
        "with the median of the distortion too, a largest one with its largest; figures of "
        "simulated readings with nothing that they do not have."
    ),
)


def compute_tables(
    names: Sequence[str] | None = None,
) -> tuple[tuple[ResultTable, ...], tuple[str, ...]]:
    """Return the table and the findings, of all profiles or of some."""
    by_name = {name: rows(name) for name in (names or profile_names())}
    table = ResultTable(
        "published and predicted, mm",
        HEADINGS,
        tuple(cells for found in by_name.values() for cells in found),
    )
    findings = []
    for name, found in by_name.items():
        profile = load_profile(name)
        more = remark(profile, planned(name, profile.volume.centre_mm[2]))
        findings.append(finding(name, found, more))
    return (table,), (*_NOTES, *findings)


CASE: Final = TablesCase(
    "table-1.1",
    "published resolution and accuracy of every device, beside what its profile predicts",
    "Table 1.1, sections 2.3 and 2.4, appendices F and G",
    compute_tables,
)
