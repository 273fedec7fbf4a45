"""Close-up panels of a line scan's plot: positions, fits and residuals."""

from dataclasses import dataclass
from math import floor, log10
from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from compute.signal.fit.line_spread_function import LineSpreadFunction
from service.api.line_scans.methods import CentroidMethod, FitMethod, Method
from service.api.line_scans.schema import FitWindow, LinePeak, LineScan

Array = NDArray[np.float64]

# Okabe and Ito's colours, told apart by colour-blind eyes.
PIXELS: Final = "0.35"
MODEL: Final = "#0072B2"
COMPONENT: Final = "#009E73"
LEVEL: Final = "#E69F00"
FLAGGED: Final = "#D55E00"

_TOGETHER: Final = 4
_HALF_PX: Final = 7.0


@dataclass(frozen=True, eq=False)
class Panel:
    """One panel of a plot: its pixels, peaks and fit.

    Args:
        first_px, last_px: its pixels.
        numbers: of the peaks in it, as the line counts them.
        window: the fit; None for other methods.
    """

    first_px: int
    last_px: int
    numbers: tuple[int, ...]
    window: FitWindow | None = None


def panels_of(pixels: int, scan: LineScan, max_panels: int) -> list[Panel]:
    """Return the panels around a scan's brightest peaks, in order of pixels."""
    panels = _of_windows(scan) if scan.windows is not None else _of_peaks(pixels, scan.peaks)

    def brightness(panel: Panel) -> float:
        return max(scan.peaks[number].amplitude or 0.0 for number in panel.numbers)

    chosen = sorted(panels, key=brightness, reverse=True)[:max_panels]
    return sorted(chosen, key=lambda panel: panel.first_px)


def _of_windows(scan: LineScan) -> list[Panel]:
    panels = []
    for window in scan.windows or ():
        places = np.array(window.position_px)
        numbers = tuple(
            number
            for number, peak in enumerate(scan.peaks)
            if np.abs(places - peak.position_px).min() < 1e-3
        )
        if numbers:
            last = window.first_px + len(window.values) - 1
            panels.append(Panel(window.first_px, last, numbers, window))
    return panels


def _of_peaks(pixels: int, peaks: list[LinePeak]) -> list[Panel]:
    half = [max(_HALF_PX, 2.0 * (peak.width_px or 0.0)) for peak in peaks]
    low = [peak.position_px - reach for peak, reach in zip(peaks, half, strict=True)]
    high = [peak.position_px + reach for peak, reach in zip(peaks, half, strict=True)]
    groups: list[list[int]] = []
    for number in range(len(peaks)):
        if groups and len(groups[-1]) < _TOGETHER and low[number] <= high[groups[-1][-1]]:
            groups[-1].append(number)
        else:
            groups.append([number])
    return [
        Panel(
            max(floor(min(low[k] for k in group)), 0),
            min(floor(max(high[k] for k in group)) + 1, pixels - 1),
            tuple(group),
        )
        for group in groups
    ]


def draw_panel(
    axes: Axes, values: NDArray[np.uint16], scan: LineScan, panel: Panel, method: Method
) -> None:
    """Draw a panel's pixels, fit or thresholds, and positions with standard deviations."""
    shown = values[panel.first_px : panel.last_px + 1].astype(np.float64)
    edges = np.arange(panel.first_px, panel.last_px + 2) - 0.5
    low, high = float(shown.min()), float(shown.max())
    axes.stairs(shown, edges, baseline=None, color=PIXELS, lw=0.9, label="pixels")
    if panel.window is not None:
        # Above saturated pixels the model goes on, but not for ever.
        high = max(high, min(_draw_fit(axes, panel.window, method), low + 3.0 * (high - low)))
    elif scan.limit_sigma is None and scan.stages and len(scan.stages) > 1:
        lowest, highest = _draw_stage(axes, scan, panel)
        low, high = min(low, lowest), max(high, highest)
    for number in panel.numbers:
        peak = scan.peaks[number]
        colour = peak_colour(peak)
        axes.axvline(peak.position_px, color=colour, lw=1.0)
        if peak.sigma_px is not None:
            axes.axvspan(
                peak.position_px - peak.sigma_px,
                peak.position_px + peak.sigma_px,
                color=colour, alpha=0.3, lw=0.0,
            )  # fmt: skip
        if isinstance(method, CentroidMethod) and peak.amplitude and peak.width_px:
            level = scan.background_counts + method.threshold_fraction * peak.amplitude
            reach = 0.5 * peak.width_px + 1.0
            axes.plot(
                [peak.position_px - reach, peak.position_px + reach], [level, level],
                "--", color=LEVEL, lw=1.2, label="threshold" if number == panel.numbers[0] else "",
            )  # fmt: skip
    axes.set_xlim(edges[0], edges[-1])
    room = max(high - low, 1.0)
    axes.set_ylim(low - 0.05 * room, high + 0.3 * room)
    axes.stairs(shown, edges, baseline=low - 0.05 * room, fill=True, color="0.88", zorder=0)
    axes.xaxis.set_major_locator(MaxNLocator(5, integer=True))
    wrong = peak_colour(*(scan.peaks[number] for number in panel.numbers)) == FLAGGED
    title = "\n".join(_described(scan, panel))
    axes.set_title(title, loc="left", fontsize=8, color=FLAGGED if wrong else "black")
    axes.legend(
        fontsize=7, loc="upper right", ncols=4, handlelength=1.2, framealpha=0.9, edgecolor="none",
        columnspacing=1.0,
    )  # fmt: skip


def draw_residuals(axes: Axes, panel: Panel) -> None:
    """Draw a fit's residual of each pixel, in standard deviations."""
    window = panel.window
    axes.set_xlim(panel.first_px - 0.5, panel.last_px + 0.5)
    axes.xaxis.set_major_locator(MaxNLocator(5, integer=True))
    axes.set_xlabel("pixel")
    if window is None or window.chi2 is None:
        axes.text(0.5, 0.5, "no fit", ha="center", va="center", transform=axes.transAxes)
        axes.set_yticks([])
        return
    pixel = window.first_px + np.arange(len(window.values))
    rest = np.array(window.residual_sigma, np.float64)
    used = np.array(window.used)
    axes.axhspan(-1.0, 1.0, color="0.93", lw=0.0)
    axes.axhline(0.0, color="0.6", lw=0.7)
    axes.vlines(pixel[used], 0.0, rest[used], color=MODEL, lw=1.0)
    axes.plot(pixel[used], rest[used], "o", color=MODEL, ms=3)
    if not used.all():
        axes.plot(pixel[~used], np.zeros((~used).sum()), "x", color=FLAGGED, ms=4)
    largest = float(np.abs(rest[used]).max(initial=0.0))
    axes.set_ylim(-1.15 * max(largest, 3.0), 1.15 * max(largest, 3.0))


def peak_colour(*peaks: LinePeak) -> str:
    """Return the colour of peaks of which one has a flag of a fault, else that of the model."""
    return FLAGGED if any(set(peak.flags) - {"joint"} for peak in peaks) else MODEL


def _draw_fit(axes: Axes, window: FitWindow, method: Method) -> float:
    """Draw the model between pixels too, and its lines one by one where there are several.

    A mask's shadow, which is not made of lines, is drawn pixel by pixel. Returns the model's
    largest value.
    """
    if not isinstance(method, FitMethod):
        edges = window.first_px + np.arange(len(window.model) + 1) - 0.5
        model = np.array(window.model, np.float64)
        axes.stairs(model, edges, baseline=None, color=MODEL, lw=1.0, label="model")
        return float(np.nanmax(model, initial=0.0))
    if window.chi2 is None or window.width_px is None or window.background_counts is None:
        return 0.0
    last = window.first_px + len(window.values) - 1
    place = np.linspace(window.first_px, last, 16 * (last - window.first_px) + 1)
    middle = 0.5 * (window.first_px + last)
    ground = window.background_counts + (window.slope_counts_per_px or 0.0) * (place - middle)
    shape = method.line_shape or LineSpreadFunction.gaussian()
    lines = []
    for position, light in zip(window.position_px, window.light_counts, strict=True):
        above, _ = shape.at((place + 0.5 - position) / window.width_px, position_px=position)
        below, _ = shape.at((place - 0.5 - position) / window.width_px, position_px=position)
        lines.append((light or 0.0) * (above - below))
    if len(lines) > 1:
        for number, line in enumerate(lines):
            axes.plot(
                place, ground + line, "--", color=COMPONENT, lw=1.0,
                label="" if number else "each line",
            )  # fmt: skip
    model = ground + np.sum(lines, axis=0)
    axes.plot(place, model, color=MODEL, lw=1.4, label="model")
    saturated = ~np.array(window.used)
    if saturated.any():
        pixel = window.first_px + np.flatnonzero(saturated)
        axes.plot(
            pixel, np.array(window.values)[saturated], "x", color=FLAGGED, ms=5, label="left out"
        )
    return float(model.max())


def _draw_stage(axes: Axes, scan: LineScan, panel: Panel) -> tuple[float, float]:
    """Draw the line that the chain measured, back on the background that it took away.

    Returns its least and its largest value in the panel.
    """
    assert scan.stages is not None
    last = scan.stages[-1]
    grounds = [np.array(stage.values) for stage in scan.stages if stage.name == "background"]
    line = np.array(last.values) + np.sum(grounds, axis=0)
    place = np.arange(len(line)) - last.shift_px
    axes.plot(place, line, color=MODEL, lw=1.4, label="after the chain")
    shown = line[(place >= panel.first_px) & (place <= panel.last_px)]
    return float(shown.min(initial=np.inf)), float(shown.max(initial=-np.inf))


def _described(scan: LineScan, panel: Panel) -> list[str]:
    """Return the lines of a panel's title; what all its peaks have in common stands last."""
    peaks = [scan.peaks[number] for number in panel.numbers]
    common = set.intersection(*(set(peak.flags) for peak in peaks))
    rows = [
        ", ".join([_position(number, peak), *(f for f in peak.flags if f not in common)])
        for number, peak in zip(panel.numbers, peaks, strict=True)
    ]
    last = [flag for flag in peaks[0].flags if flag in common]
    if panel.window is not None and panel.window.width_px is not None:
        last.insert(0, f"width {panel.window.width_px:.3g} px")
    if peaks[0].reduced_chi2 is not None:
        last.insert(0, f"χ²/dof {peaks[0].reduced_chi2:.2f}")
    return [*rows, ", ".join(last)] if last else rows


def _position(number: int, peak: LinePeak) -> str:
    if peak.sigma_px is None:
        text = f"{number + 1}: {peak.position_px:.6g} px"
    else:
        digits = max(0, 1 - floor(log10(peak.sigma_px))) if peak.sigma_px > 0.0 else 4
        text = f"{number + 1}: {peak.position_px:.{digits}f} ± {peak.sigma_px:.{digits}f} px"
    if peak.response_sigma is not None:
        text += f", {peak.response_sigma:.1f} deviations"
    return text
