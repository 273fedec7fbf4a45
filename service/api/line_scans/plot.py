"""Plot of a line scan: peaks, fits and residuals."""

import io
from typing import Final

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure, SubFigure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray
from PIL import Image

from service.api.line_scans.methods import Method
from service.api.line_scans.plot_panels import (
    COMPONENT,
    FLAGGED,
    LEVEL,
    MODEL,
    PIXELS,
    Panel,
    draw_panel,
    draw_residuals,
    panels_of,
    peak_colour,
)
from service.api.line_scans.schema import LinePeak, LineScan, LineScans, Stage

Counts = NDArray[np.uint16]

MAX_PANELS: Final = 8
_COLUMNS: Final = 4
_MAX_NUMBERS: Final = 24
_DPI: Final = 110
_HEADROOM: Final = 0.35
_NAMES: Final = {
    "centroid": "by centre of gravity",
    "fit": "fitted",
    "chain": "by the thesis's chain",
    "matched": "by the matched filter",
    "mask": "by the mask's shadow",
}


def draw_scan(values: Counts, found: LineScans, method: Method, title: str) -> bytes:
    """Return the picture of one line as PNG.

    No state of pyplot's is used, so that it may be called in any thread.

    Args:
        values: the line's counts, shape (P,).
        found: what was found in it, with detail: its first line is drawn.
        method: how.
        title: which line it is.
    """
    scan = found.scans[0]
    panels = panels_of(len(values), scan, MAX_PANELS)
    # The chain's first stage is the line itself.
    beyond = 0 if scan.limit_sigma is not None else 1
    stage = scan.stages[-1] if scan.stages and len(scan.stages) > beyond else None
    rows = -(-len(panels) // _COLUMNS)
    above = [3.2, 2.4] if stage else [3.2]
    heights = [sum(above), *([4.2 if scan.windows else 3.0] * rows)]
    with mpl.rc_context({"font.size": 9, "axes.titlesize": 9}):
        figure = Figure(figsize=(14.0, 0.8 + sum(heights)), layout="constrained")
        FigureCanvasAgg(figure)
        figure.suptitle(f"{title}: {_summary(scan, found, panels, len(values))}", fontsize=12)
        grid = figure.add_gridspec(len(heights), 1, height_ratios=heights)
        parts = [figure.add_subfigure(grid[row]) for row in range(len(heights))]
        whole = parts[0].subplots(len(above), squeeze=False, height_ratios=above)[:, 0]
        _whole_line(whole[0], values, scan, found)
        if stage is not None:
            _last_stage(whole[1], stage, scan, len(values))
        columns = _COLUMNS if rows > 1 else max(len(panels), 2)
        if found.method == "mask":
            columns = 1  # its window is the whole line
        for row, part in enumerate(parts[1:]):
            some = panels[row * columns : (row + 1) * columns]
            _panels(part, values, scan, some, columns, method)
        drawn, small = io.BytesIO(), io.BytesIO()
        figure.savefig(drawn, format="png", dpi=_DPI)
    # A palette of 256 colours takes less than half of the bytes.
    Image.open(drawn).convert("RGB").quantize(256).save(small, "png", optimize=True)
    return small.getvalue()


def _summary(scan: LineScan, found: LineScans, panels: list[Panel], pixels: int) -> str:
    count = len(scan.peaks)
    text = f"{count or 'no'} peak{'' if count == 1 else 's'} {_NAMES[found.method]}"
    flags = sorted({flag for peak in scan.peaks for flag in peak.flags})
    if flags:
        counted = (f"{sum(flag in peak.flags for peak in scan.peaks)} {flag}" for flag in flags)
        text += f" ({', '.join(counted)})"
    shown = sum(len(panel.numbers) for panel in panels)
    if shown < count:
        text += f"; the brightest {shown} below"
    if scan.saturated_pixels:
        text += f"; {scan.saturated_pixels} of {pixels} pixels saturated"
    guessed = ", guessed from the line" if found.assumed else ""
    return (
        f"{text}\nbackground {scan.background_counts:.5g} counts, noise there "
        f"{scan.noise_counts:.3g} counts{guessed} (measured in the line: "
        f"{scan.measured_noise_counts:.3g})"
    )


def _whole_line(axes: Axes, values: Counts, scan: LineScan, found: LineScans) -> None:
    axes.stairs(
        values, np.arange(len(values) + 1) - 0.5, baseline=None, color=PIXELS, lw=0.8,
        label="pixels",
    )  # fmt: skip
    axes.axhline(scan.background_counts, color=COMPONENT, lw=1.0, label="background")
    low, high = float(values.min()), float(values.max())
    if scan.limit_counts is not None:
        axes.axhline(
            scan.limit_counts, ls="--", color=LEVEL, lw=1.0, label="least height of a peak"
        )
        high = max(high, scan.limit_counts)
    full = found.noise.full_scale_counts
    if high >= 0.8 * full:
        axes.axhline(full, ls=":", color=FLAGGED, lw=1.0, label="full scale")
        high = max(high, float(full))
    room = max(high - low, 1.0)
    for number, peak in enumerate(scan.peaks):
        if not -0.5 <= peak.position_px <= len(values) - 0.5:
            continue  # the reading of a mask's shadow may lie beyond the line
        _mark(axes, number, peak, float(_top(values, peak)) + 0.03 * room, len(scan.peaks))
    axes.set(xlim=(-0.5, len(values) - 0.5), ylabel="counts", xlabel="pixel")
    axes.set_ylim(low - 0.05 * room, high + _HEADROOM * room)
    axes.legend(fontsize=8, loc="upper right", ncols=4)


def _top(values: Counts, peak: LinePeak) -> int:
    pixel = min(max(round(peak.position_px), 0), len(values) - 1)
    return int(values[max(pixel - 1, 0) : pixel + 2].max())


def _mark(axes: Axes, number: int, peak: LinePeak, height: float, count: int) -> None:
    colour = peak_colour(peak)
    axes.plot(peak.position_px, height, "v", color=colour, ms=4, clip_on=False)
    if count <= _MAX_NUMBERS:
        axes.annotate(
            str(number + 1), (peak.position_px, height), (0.0, 4.0), textcoords="offset points",
            ha="center", fontsize=8, color=colour,
        )  # fmt: skip


def _last_stage(axes: Axes, stage: Stage, scan: LineScan, pixels: int) -> None:
    """Draw the last stage of processing, where peaks are not found in the scan itself."""
    answer = scan.limit_sigma is not None
    place = np.arange(len(stage.values)) - stage.shift_px
    axes.plot(place, stage.values, color=MODEL, lw=0.8)
    if scan.limit_sigma is not None:
        axes.axhline(scan.limit_sigma, ls="--", color=LEVEL, lw=1.0)
        if max(stage.values) > 5.0 * scan.limit_sigma:
            _logarithmic(axes, stage.values, scan.limit_sigma)
        what = "answer of the matched filter"
        if stage.name == "correlation":
            what = "correlation with the shadow"
        text = f"{what}; threshold {scan.limit_sigma:.2f} deviations"
    else:
        moved = f", moved back by {stage.shift_px:.3g} px" if stage.shift_px else ""
        names = ", ".join(one.name for one in scan.stages or ())
        text = f"the line after all steps of the chain ({names}){moved}"
    axes.axhline(0.0, color="0.7", lw=0.7)
    for peak in scan.peaks:
        colour = peak_colour(peak)
        axes.axvline(peak.position_px, color=colour, lw=0.6, alpha=0.5)
    axes.set(xlim=(-0.5, pixels - 0.5), xlabel="pixel")
    axes.set_ylabel("deviations of noise" if answer else "counts")
    axes.set_title(text, loc="left")


def _logarithmic(axes: Axes, values: list[float], limit: float) -> None:
    """Set a symmetric logarithmic axis: responses of 1000 sigma and noise on one axis."""
    axes.set_yscale("symlog", linthresh=2.0 * limit)
    decades = [sign * 10.0**power for sign in (-1, 1) for power in range(1, 6)]
    axes.set_yticks([0.0, *(one for one in decades if abs(one) > 1.5 * limit)])
    axes.set_yticks([], minor=True)
    axes.set_ylim(1.5 * min(min(values), -limit), 2.0 * max(values))


def _panels(
    part: SubFigure,
    values: Counts,
    scan: LineScan,
    panels: list[Panel],
    columns: int,
    method: Method,
) -> None:
    """Draw up to four panels side by side, with the residuals of fits below."""
    fitted = scan.windows is not None
    axes = part.subplots(
        2 if fitted else 1, columns, squeeze=False, height_ratios=(2.4, 1.0) if fitted else (1.0,)
    )
    for column in range(columns):
        if column >= len(panels):
            for row in axes:
                row[column].set_axis_off()
            continue
        draw_panel(axes[0, column], values, scan, panels[column], method)
        if fitted:
            axes[0, column].tick_params(labelbottom=False)
            draw_residuals(axes[1, column], panels[column])
        else:
            axes[0, column].set_xlabel("pixel")
    axes[0, 0].set_ylabel("counts")
    if fitted:
        axes[1, 0].set_ylabel("residual / σ")
        axes[1, 0].yaxis.set_major_locator(MaxNLocator(5))
