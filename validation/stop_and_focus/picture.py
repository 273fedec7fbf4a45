"""Figure of case stop-and-focus: stripes by the position of the stop, figures by its width."""

from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from compute.optics.stripe_optics.stripe_profile import CELLS
from validation.aberrations.thesis_lens import STOP_PLACES, stopped_lens
from validation.stop_and_focus.case import NO_STOP, WIDTHS_MM, StopFigures, all_stops, stop_figures
from validation.stop_and_focus.stripe_quality import ELECTRONS_PER_SR, FIELD_POSITIONS, traced_lines

if TYPE_CHECKING:
    from collections.abc import Callable

# Okabe and Ito's colours, which everybody can tell apart.
_COLOURS: Final = dict(zip(STOP_PLACES, ("#0072B2", "#E69F00", "#009E73", "#CC79A7"), strict=True))
_DRAWN_MM: Final = 4.0
_REACH_PX: Final = 50.0


def draw(path: Path) -> None:
    """Draw lines of a stop of 4 mm at four places, and width and bound by the stop's width."""
    figure = Figure(figsize=(13.0, 8.0), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(2, 3)
    for position in STOP_PLACES:
        stop = stop_figures(_DRAWN_MM, position)
        assembly = stopped_lens(_DRAWN_MM, position, stop.focus_mm)
        lines = traced_lines(assembly, np.array(list(FIELD_POSITIONS.values())))
        for number, axis in enumerate(axes[0]):
            axis.plot(
                lines.centres_px[number] - lines.centroid_px[number],
                # What a pixel gets that has its middle there.
                np.convolve(lines.cell_sr[number], np.ones(CELLS), "same") * ELECTRONS_PER_SR,
                color=_COLOURS[position],
                label=f"{position} ({stop.focus_mm:+.2f} mm)",
            )
    for axis, name in zip(axes[0], FIELD_POSITIONS, strict=True):
        axis.set(
            xlim=(-_REACH_PX, _REACH_PX),
            xlabel="distance from the centre of gravity [px]",
            title=f"stop of {_DRAWN_MM:g} mm, {name}",
        )
        axis.set_ylim(bottom=0.0)
    axes[0, 0].set_ylabel("light in a pixel [electrons]")
    figure.legend(
        *axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=4,
        title="place of the stop (the sensor's, from the paraxial image)",
    )  # fmt: skip
    _by_width(axes[1], all_stops())
    figure.suptitle(
        "Lens of section 3.4, LED at 1.5 m, the sensor where the lines of the whole field are "
        "narrowest"
    )
    figure.savefig(path, dpi=110)


def _by_width(axes: np.ndarray, stops: tuple[StopFigures, ...]) -> None:
    (none,) = (stop for stop in stops if stop.position == NO_STOP)
    columns: tuple[tuple[str, Callable[[StopFigures], float]], ...] = (
        ("middle half of the light, corner [px]", lambda stop: stop.lines[2].middle_50_px),
        ("error of the centre of gravity, field's RMS [px]", lambda stop: stop.gravity_px),
        ("Cramer-Rao bound, field's RMS [px]", lambda stop: stop.bound_px),
    )
    for axis, (label, value) in zip(axes, columns, strict=True):
        for position in STOP_PLACES:
            shown = [stop for stop in stops if stop.position == position]
            axis.plot(
                [stop.width_mm for stop in shown],
                [value(stop) for stop in shown],
                "o-",
                color=_COLOURS[position],
            )
        axis.plot([none.width_mm], [value(none)], "ks", label="no stop")
        axis.set(xscale="log", yscale="log", xlabel="width of the stop [mm]", ylabel=label)
        axis.set_xticks(WIDTHS_MM, [f"{width:g}" for width in WIDTHS_MM], minor=False)
        axis.set_xticks([], minor=True)
        axis.grid(alpha=0.3, which="both")
    axes[0].legend(fontsize="small")
