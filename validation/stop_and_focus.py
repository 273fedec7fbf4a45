"""Case stop-and-focus: which stop, where, and where to focus; what each costs."""

from dataclasses import dataclass
from functools import cache
from typing import Final

import numpy as np

from compute.errors import LumilineError
from compute.optics.aberrations.field_distortion import all_terms
from validation.aberrations_lens import STOP_PLACES, WIDTH_MM, StopPlace, stopped_lens
from validation.stop_figures import (
    ELECTRONS_PER_SR,
    PLACES_OF_FIELD,
    READ_NOISE_ELECTRONS,
    LineFigures,
    best_focus_mm,
    coma_free_stop_mm,
    distortion_px,
    line_figures,
    root_mean_square,
)
from validation.tables import Cell, ResultTable, TablesCase

WIDTHS_MM: Final = (2.0, 3.0, 4.0, 6.0, 10.0, WIDTH_MM)
SHIFTS_MM: Final = (-1.0, -0.5, 0.0, 0.5, 1.0)
RECOMMENDED: Final[StopPlace] = "8 mm in front"
NO_STOP: Final = "none"

FIELD: Final = np.array(list(PLACES_OF_FIELD.values()))
_NAMES: Final = tuple(PLACES_OF_FIELD)


@dataclass(frozen=True)
class StopFigures:
    """A stop with the sensor where the lines of the whole field are narrowest.

    Args:
        width_mm: width of the stop [mm].
        place: where it is; NO_STOP for the whole lens.
        focus_mm: the sensor's place, from the paraxial image [mm].
        lines: in the middle, at the row's end, in the corner.
        distortion_px: what a camera of seven parameters leaves, RMS [px]; None: cannot be fitted.
    """

    width_mm: float
    place: str
    focus_mm: float
    lines: tuple[LineFigures, ...]
    distortion_px: float | None

    @property
    def bound_px(self) -> float:
        """Root mean square of the three bounds [px]."""
        return root_mean_square([line.bound_px for line in self.lines])

    @property
    def gravity_px(self) -> float:
        """Root mean square of the three errors of the centre of gravity [px]."""
        return root_mean_square([line.gravity_px for line in self.lines])


@cache
def stop_figures(width_mm: float, place: StopPlace) -> StopFigures:
    """Return the figures of a stop at its best focus over the field."""
    focus = best_focus_mm(width_mm, place, FIELD)
    assembly = stopped_lens(width_mm, place, focus)
    try:
        distortion: float | None = distortion_px(assembly)
    except LumilineError:
        distortion = None
    lines = line_figures(assembly, width_mm, FIELD)
    name = place if width_mm < WIDTH_MM else NO_STOP
    return StopFigures(width_mm, name, focus, lines, distortion)


def all_stops() -> tuple[StopFigures, ...]:
    """Return the figures of all stops, and of the lens without one."""
    return tuple(
        stop_figures(width, place)
        for place in STOP_PLACES
        for width in WIDTHS_MM
        if width < WIDTH_MM or place == STOP_PLACES[0]
    )


def work_out() -> tuple[tuple[ResultTable, ...], tuple[str, ...]]:
    """Return the tables of stops and of focus, and what a builder should choose."""
    stops = all_stops()
    by = {(stop.place, stop.width_mm): stop for stop in stops}
    narrow, wide = by[RECOMMENDED, 2.0], by[RECOMMENDED, 6.0]
    plane, curved = by["on the plane face", 2.0], by["on the curved face", 2.0]
    whole = by[NO_STOP, WIDTH_MM]
    gravity = min(stops, key=lambda stop: stop.gravity_px)
    bound = min(stops, key=lambda stop: stop.bound_px)
    focused = _focus_lines(RECOMMENDED, best_focus_mm(4.0, RECOMMENDED, FIELD[:1]))
    balanced = by[RECOMMENDED, 4.0].lines
    findings = (
        (
            "Take a slit of 2 to 3 mm, 8 mm before the plane face, and the sensor "
            f"{-narrow.focus_mm:.2g} mm nearer than the paraxial image. Seidel's sums put the stop "
            f"without coma at {coma_free_stop_mm():.1f} mm: lines there are symmetrical all over "
            f"the field (gravity less median at most {_largest_lopsided(narrow):.2f} px with 2 mm; "
            f"on the plane face {_largest_lopsided(plane):.2f}, on the curved face "
            f"{_largest_lopsided(curved):.2f}) and narrowest. Of all stops here "
            f"{gravity.width_mm:g} mm, {gravity.place}, has the least error of the thesis's centre "
            f"of gravity over the field, {gravity.gravity_px:.3f} px RMS."
        ),
        (
            f"It costs light: 2 mm pass {_share(narrow, whole):.0f} % of what the whole lens does "
            "in the middle of the field. Off the axis a line is as wide as the stop makes it, by "
            "curvature of field, so that more stop adds width, and ambient light, with the light: "
            f"6 mm have three times the light of 2 mm, and {wide.gravity_px:.3f} px instead of "
            f"{narrow.gravity_px:.3f} px of error; the whole lens has {whole.gravity_px:.3f} px."
        ),
        (
            f"The least bound, {bound.bound_px:.3f} px RMS, is that of {bound.width_mm:g} mm, "
            f"{bound.place}. It rests on the sharp edges (caustics) of lines whose middle half is "
            f"up to {max(line.middle_50_px for line in bound.lines):.0f} px wide: whoever wants it "
            "must know each line's shape at every distance, and cannot tell two markers so close. "
            f"The centre of gravity has {bound.gravity_px:.3f} px there."
        ),
        (
            "Distortion is no reason to choose a stop by: the place that makes the lines good has "
            f"{_figure(narrow.distortion_px)} px of it, the curved face "
            f"{_figure(curved.distortion_px)} px, and terms in both field angles to order 5 leave "
            f"{_modelled(RECOMMENDED):.3f} and {_modelled('on the curved face'):.3f} px of them. "
            "Width and lopsidedness cannot be calibrated away so: they change "
            "with the distance."
        ),
        (
            "Focused for the middle of the field alone, with 4 mm, the line's middle half there is "
            f"{focused[0].middle_50_px:.1f} px instead of {balanced[0].middle_50_px:.1f}, at the "
            f"row's end {focused[1].middle_50_px:.1f} instead of {balanced[1].middle_50_px:.1f}, "
            f"in the corner {focused[2].middle_50_px:.1f} instead of "
            f"{balanced[2].middle_50_px:.1f}: right for a device that uses the middle only."
        ),
        (
            f"Assumed: an LED of 0.3 mm at 950 nm and 1.5 m that gives {ELECTRONS_PER_SR:g} "
            f"photoelectrons per sr, ambient light of 250 electrons per pixel and mm of stop, "
            f"{READ_NOISE_ELECTRONS:g} electrons of read noise, pixels of 12 x 12 um, no "
            "saturation. The RMS width has diffraction's tails to 20 px in it."
        ),
    )
    return (_stop_table(stops), _focus_table()), findings


def _stop_table(stops: tuple[StopFigures, ...]) -> ResultTable:
    rows: list[tuple[Cell, ...]] = []
    for stop in stops:
        for name, line in zip(_NAMES, stop.lines, strict=True):
            first = name == _NAMES[0]
            rows.append(
                (
                    stop.place, stop.width_mm, stop.focus_mm, name, line.rms_px,
                    line.middle_50_px, line.lopsided_px, line.electrons, line.bound_px,
                    line.gravity_px,
                    stop.distortion_px if first else None,
                )
            )  # fmt: skip
    return ResultTable(
        "stops, the sensor where the lines of the field are narrowest [mm, px, electrons]",
        (
            "stop", "width", "focus", "field", "RMS", "50 %", "gravity - median", "light",
            "bound", "gravity", "distortion",
        ),
        tuple(rows),
    )  # fmt: skip


def _focus_table() -> ResultTable:
    rows: list[tuple[Cell, ...]] = []
    places: tuple[StopPlace, ...] = (RECOMMENDED, "on the plane face")
    for place in places:
        best = stop_figures(4.0, place).focus_mm
        middle = best_focus_mm(4.0, place, FIELD[:1])
        shifts = [(f"{shift:+.1f}", best + shift) for shift in SHIFTS_MM]
        for label, focus in (*shifts, ("middle's focus", middle)):
            lines = _focus_lines(place, focus)
            rows.append(
                (
                    place, label, focus,
                    *(line.middle_50_px for line in lines),
                    *(line.lopsided_px for line in lines[1:]),
                    *(line.bound_px for line in lines),
                    distortion_px(stopped_lens(4.0, place, focus)),
                )
            )  # fmt: skip
    return ResultTable(
        "focus of a stop of 4 mm: 50 % width, gravity - median and bound in the middle, at the "
        "row's end and in the corner [mm, px]",
        (
            "stop", "shift", "from paraxial", "50 % m", "50 % e", "50 % c", "g-m e", "g-m c",
            "bound m", "bound e", "bound c", "distortion",
        ),
        tuple(rows),
    )  # fmt: skip


def _focus_lines(place: StopPlace, focus_mm: float) -> tuple[LineFigures, ...]:
    return line_figures(stopped_lens(4.0, place, focus_mm), 4.0, FIELD)


def _modelled(place: StopPlace) -> float:
    stop = stop_figures(2.0, place)
    return distortion_px(stopped_lens(2.0, place, stop.focus_mm), all_terms(5))


def _largest_lopsided(stop: StopFigures) -> float:
    return max(abs(line.lopsided_px) for line in stop.lines)


def _share(stop: StopFigures, whole: StopFigures) -> float:
    return 100.0 * stop.lines[0].electrons / whole.lines[0].electrons


def _figure(value: float | None) -> str:
    return "no fit" if value is None else f"{value:.1f}"


CASE: Final = TablesCase(
    "stop-and-focus",
    "width, lopsidedness, light, bound and distortion by stop and focus",
    "sections 3.3.2 (aperture stop, Figure 3.12) and 3.4; a builder's question",
    work_out,
)
