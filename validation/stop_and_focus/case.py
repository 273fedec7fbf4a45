"""Case stop-and-focus: effects of the stop and the focus on precision and distortion."""

from dataclasses import dataclass
from functools import cache
from typing import Final

import numpy as np

from compute.camera.field_distortion import all_terms
from compute.errors import LumilineError
from validation.aberrations.thesis_lens import STOP_PLACES, WIDTH_MM, StopPlace, stopped_lens
from validation.result_tables import Cell, ResultTable, TablesCase
from validation.stop_and_focus.stripe_quality import (
    ELECTRONS_PER_SR,
    FIELD_POSITIONS,
    READ_NOISE_ELECTRONS,
    LineFigures,
    best_focus_mm,
    coma_free_stop_mm,
    distortion_px,
    line_figures,
    root_mean_square,
)

WIDTHS_MM: Final = (2.0, 3.0, 4.0, 6.0, 10.0, WIDTH_MM)
SHIFTS_MM: Final = (-1.0, -0.5, 0.0, 0.5, 1.0)
RECOMMENDED: Final[StopPlace] = "8 mm in front"
NO_STOP: Final = "none"

FIELD: Final = np.array(list(FIELD_POSITIONS.values()))
_NAMES: Final = tuple(FIELD_POSITIONS)
_SHORT: Final = {
    "8 mm in front": "8 mm before",
    "on the plane face": "plane face",
    "on the curved face": "curved face",
    "4 mm behind": "4 mm behind",
    NO_STOP: NO_STOP,
}
_ALIKE: Final = 1.05  # ratio of errors below which two stops are not told apart


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
    position: str
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
        stop_figures(width, position)
        for position in STOP_PLACES
        for width in WIDTHS_MM
        if width < WIDTH_MM or position == STOP_PLACES[0]
    )


def compute_tables() -> tuple[tuple[ResultTable, ...], tuple[str, ...]]:
    """Return the tables of stops and of focus, and what a builder should choose."""
    stops = all_stops()
    by = {(stop.position, stop.width_mm): stop for stop in stops}
    narrow, wide = by[RECOMMENDED, 2.0], by[RECOMMENDED, 6.0]
    plane, curved = by["on the plane face", 2.0], by["on the curved face", 2.0]
    whole = by[NO_STOP, WIDTH_MM]
    least = min(stop.gravity_px for stop in stops)
    good = [stop for stop in stops if stop.gravity_px < _ALIKE * least]
    bound = min(stops, key=lambda stop: stop.bound_px)
    focused = _focus_lines(RECOMMENDED, best_focus_mm(4.0, RECOMMENDED, FIELD[:1]))
    balanced = by[RECOMMENDED, 4.0].lines
    findings = (
        (
            "Take a slit of 2 to 3 mm, 8 mm before the plane face, and the sensor "
            f"{-narrow.focus_mm:.2g} mm nearer than the paraxial image. Seidel's sums put the stop "
            f"without coma at {coma_free_stop_mm():.1f} mm: lines there are symmetrical all over "
            f"the field (gravity less median at most {_max_asymmetry(narrow):.2f} px with 2 mm; "
            f"on the plane face {_max_asymmetry(plane):.2f}, on the curved face "
            f"{_max_asymmetry(curved):.2f}) and narrowest. Of all stops here "
            "the thesis's centre of gravity has the least error over the field behind "
            f"{_listed(good)}, which are alike within 5 %."
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
            f"{bound.position}. It rests on the sharp edges (caustics) of lines whose middle half "
            f"is up to {max(line.middle_50_px for line in bound.lines):.0f} px wide: whoever wants "
            "it must know each line's shape at every distance, and cannot tell two markers so "
            f"close. The centre of gravity has {bound.gravity_px:.3f} px there."
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
    return (_stop_table(stops), _line_table(stops), *_focus_tables()), findings


def _stop_table(stops: tuple[StopFigures, ...]) -> ResultTable:
    return ResultTable(
        "stops, the sensor where the lines of the field are narrowest; light in the middle, bound "
        "and gravity RMS over the field [mm, electrons, px]",
        ("stop", "width", "focus", "light", "bound", "gravity", "distortion"),
        tuple(
            (
                _SHORT[stop.position], stop.width_mm, stop.focus_mm,
                *_digits(stop.lines[0].electrons, stop.bound_px, stop.gravity_px),
                None if stop.distortion_px is None else _digits(stop.distortion_px)[0],
            )
            for stop in stops
        ),
    )  # fmt: skip


def _line_table(stops: tuple[StopFigures, ...]) -> ResultTable:
    return ResultTable(
        "their lines by place in the field: widths, gravity less median (g - m), bound, error of "
        "gravity [px]",
        ("stop", "width", "field", "RMS", "50 %", "g - m", "bound", "gravity"),
        tuple(
            (
                _SHORT[stop.position], stop.width_mm, name,
                *_digits(
                    line.rms_px, line.middle_50_px, line.asymmetry_px, line.bound_px,
                    line.gravity_px,
                ),
            )
            for stop in stops
            for name, line in zip(_NAMES, stop.lines, strict=True)
        ),
    )  # fmt: skip


def _focus_tables() -> tuple[ResultTable, ResultTable]:
    widths: list[tuple[Cell, ...]] = []
    bounds: list[tuple[Cell, ...]] = []
    places: tuple[StopPlace, ...] = (RECOMMENDED, "on the plane face")
    for position in places:
        best = stop_figures(4.0, position).focus_mm
        centre = best_focus_mm(4.0, position, FIELD[:1])
        shifts = [(f"{shift:+.1f}", best + shift) for shift in SHIFTS_MM]
        for label, focus in (*shifts, ("middle", centre)):
            lines = _focus_lines(position, focus)
            distortion = distortion_px(stopped_lens(4.0, position, focus))
            first = (_SHORT[position], label, focus)
            widths.append((*first, *_digits(*(line.middle_50_px for line in lines), distortion)))
            lopsided = _digits(*(line.asymmetry_px for line in lines[1:]))
            bounds.append((*first[:2], *lopsided, *_digits(*(line.bound_px for line in lines))))
    return (
        ResultTable(
            "focus of a stop of 4 mm, shifted from the field's best, or the middle's best: 50 % "
            "widths in the middle (m), at the row's end (e), in the corner (c) [mm, px]",
            ("stop", "shift", "focus", "50 % m", "50 % e", "50 % c", "distortion"),
            tuple(widths),
        ),
        ResultTable(
            "the same: gravity less median (g - m), and bound [px]",
            ("stop", "shift", "g - m e", "g - m c", "bound m", "bound e", "bound c"),
            tuple(bounds),
        ),
    )


def _digits(*values: float) -> tuple[float, ...]:
    return tuple(round(float(f"{value:.3g}"), 4) for value in values)


def _focus_lines(place: StopPlace, focus_mm: float) -> tuple[LineFigures, ...]:
    return line_figures(stopped_lens(4.0, place, focus_mm), 4.0, FIELD)


def _modelled(place: StopPlace) -> float:
    stop = stop_figures(2.0, place)
    return distortion_px(stopped_lens(2.0, place, stop.focus_mm), all_terms(5))


def _listed(stops: list[StopFigures]) -> str:
    return " and ".join(
        f"{stop.width_mm:g} mm, {stop.position} ({stop.gravity_px:.3f} px RMS)" for stop in stops
    )


def _max_asymmetry(stop: StopFigures) -> float:
    return max(abs(line.asymmetry_px) for line in stop.lines)


def _share(stop: StopFigures, whole: StopFigures) -> float:
    return 100.0 * stop.lines[0].electrons / whole.lines[0].electrons


def _figure(value: float | None) -> str:
    return "no fit" if value is None else f"{value:.1f}"


CASE: Final = TablesCase(
    "stop-and-focus",
    "width, lopsidedness, light, bound and distortion by stop and focus",
    "sections 3.3.2 (aperture stop, Figure 3.12) and 3.4; a builder's question",
    compute_tables,
)
