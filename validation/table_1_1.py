"""Table 1.1 beside predictions: published resolution and accuracy of every device profile."""

from collections.abc import Mapping, Sequence
from functools import cache
from typing import Final

import numpy as np

from compute.camera.model import Vector3
from compute.optics.profiles.loader import load_profile, profile_names
from compute.optics.profiles.parts import Axis, PublishedFigure
from compute.optics.profiles.profile import DeviceProfile
from compute.planning.coverage import Box
from compute.planning.plan import plan
from compute.planning.result import Plan
from validation.tables import Cell, ResultTable, TablesCase

GRID: Final = 3
LIKE: Final = 1.25
"""Figures that differ by a smaller factor are called the same."""

HEADINGS: Final = (
    "device", "figure", "axis", "at, mm", "published", "bound", "c.o.g.", "half px",
    "distortion", "worst",
)  # fmt: skip


@cache
def planned(name: str, distance_mm: float) -> Plan:
    """Return the plan of a profile, its volume moved to a distance [mm]."""
    profile = load_profile(name)
    x, y, _ = profile.volume.centre_mm
    box = Box((x, y, distance_mm), profile.volume.size_mm)
    return plan(profile, grid=GRID, markers=1, volume=box)


def along(values: Vector3 | None, axis: Axis) -> float | None:
    """Return a figure along a published axis [mm].

    "lateral" is the larger of X and Y; "3d" the root of the sum of the three squares.
    """
    if values is None:
        return None
    x, y, z = values
    of_axis = {"x": x, "y": y, "z": z, "depth": z, "lateral": max(x, y)}
    return of_axis[axis] if axis in of_axis else float(np.linalg.norm(values))


def row(profile: DeviceProfile, figure: PublishedFigure | None) -> tuple[Cell, ...]:
    """Return a row of the table: a published figure (or none) and what is predicted there."""
    distance = profile.volume.centre_mm[2]
    if figure is not None and figure.distance_mm is not None:
        distance = figure.distance_mm
    found = planned(profile.name, distance)
    axis: Axis = "3d" if figure is None else figure.axis
    pixel = along(found.dilution.middle, axis)
    return (
        profile.name,
        "none" if figure is None else figure.quantity,
        axis,
        distance,
        None if figure is None else figure.value_mm,
        along(found.noise.middle, axis),
        along(found.centroid.middle or found.centroid.median, axis),
        None if pixel is None else 0.5 * pixel,
        along(found.distortion.median, axis),
        along(found.distortion.worst, axis),
    )


def rows(name: str) -> list[tuple[Cell, ...]]:
    """Return the rows of a profile, one for each published figure; one if there is none."""
    profile = load_profile(name)
    figures: Sequence[PublishedFigure | None] = profile.published or (None,)
    return [row(profile, figure) for figure in figures]


def finding(name: str, found: Sequence[tuple[Cell, ...]]) -> str:
    """Say how the published figures of a device lie to the predicted ones, and why."""
    parts = []
    for cells in found:
        _, quantity, axis, _, published, *predicted = cells
        if isinstance(published, float):
            parts.append(f"{quantity} {axis} {published:g} mm {_place(published, predicted)}")
    why = REASONS.get(name, "")
    return f"{name}: {'; '.join(parts) or 'no figure was published'}. {why}".strip()


def _place(published: float, predicted: Sequence[Cell]) -> str:
    """Say where a published figure lies among bound, c.o.g., half px, distortion and worst."""
    noise, _, half, _, worst = (value if isinstance(value, float) else None for value in predicted)
    if noise is None or half is None or worst is None:
        return "beside no prediction"
    for known, what in ((noise, "is the noise"), (half, "is half a pixel in every reading")):
        if abs(np.log(published / known)) < np.log(LIKE):
            return what
    if published < noise:
        return f"is {noise / published:.3g} times below the noise"
    if published > worst:
        return f"is {published / worst:.3g} times above the worst distortion"
    return "lies between noise and uncorrected distortion"


REASONS: Final[Mapping[str, str]] = {
    "mitchelson-1971": (
        "The rounding to 12 bits, 1/sqrt(12) of a step of the plate, explains the figure alone."
    ),
    "leo-macellari-1981": (
        "A pixel is 1 mm at 5 m, so the resolution is that of whole pixels, read by a threshold. "
        "The error at the sides is larger than our lens distorts: the real lens and its focus "
        "are not known."
    ),
    "macellari-1983": (
        "Half a pixel, from which the source takes its 0.6 mm, makes 4.4 mm in depth by the "
        "geometry alone: the figure that Table 1.1 prints as the resolution and section 2.3 as "
        "the largest depth error. The lateral errors are of the size of uncorrected distortion."
    ),
    "optotrak": (
        "The published accuracy needs the distortion corrected to a few per cent of itself: hence "
        "the 19 parameters of the factory's calibration. The resolution is a centroid's noise."
    ),
    "coda-mpx30": (
        "A window hardly distorts, and its light is plenty. The three published errors are one "
        "error of 0.03 to 0.04 px in every reading, spread by the geometry: of the correlation "
        "and the calibration, not of noise."
    ),
    "flashpoint": "Reached with the distortion corrected; noise would allow far more.",
    "owen-1995": (
        "The source takes distortion for the cause: 20 and 6 px on its sensors, more than our "
        "stopped lens has. That depth is worse than width by 5 to 9 times is predicted."
    ),
    "thesis-5.1": (
        "Simulated with rays, so without noise: what is left is distortion, less what the cubic "
        "term of [5.2] removed. The stop, which the source has not, is ours."
    ),
    "thesis-5.2": (
        "Readings from perspective itself: neither noise nor distortion are in the published "
        "figures, but rounding and the method's arithmetic."
    ),
    "thesis-5.9": (
        "Neither noise nor distortion explains it: the same readings, calibrated with the seven "
        "parameters, leave a fifth to two fifths (case test-5.4). Wrong labels (test-5.3) and a "
        "DLT without weights do."
    ),
}
"""What explains a device's figures, as far as is known."""

_NOTES: Final = (
    (
        "Predicted from the profiles, whose lenses, stops and markers are mostly assumed: orders "
        "of magnitude, not digits. bound, c.o.g.: standard deviation of one exposure in the "
        "middle of the volume, readings at the Cramer-Rao bound or by centre of gravity. half px: "
        "an error of half a pixel (or of half a step of a Gray plate) in every reading."
    ),
    (
        "distortion, worst: what perspective cameras calibrated in the volume leave of the lenses' "
        f"distortion, median and largest of {GRID**3} points, without correction. Lateral is the "
        "larger of X and Y; 3d all three."
    ),
)


def work_out(
    names: Sequence[str] | None = None,
) -> tuple[tuple[ResultTable, ...], tuple[str, ...]]:
    """Return the table and the findings, of all profiles or of some."""
    by_name = {name: rows(name) for name in (names or profile_names())}
    table = ResultTable(
        "published and predicted, mm",
        HEADINGS,
        tuple(cells for found in by_name.values() for cells in found),
    )
    findings = tuple(finding(name, found) for name, found in by_name.items())
    return (table,), (*_NOTES, *findings)


CASE: Final = TablesCase(
    "table-1.1",
    "published resolution and accuracy of every device, beside what its profile predicts",
    "Table 1.1, sections 2.3 and 2.4, appendices F and G",
    work_out,
)
