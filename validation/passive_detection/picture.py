"""Figure of case passive-detection: operating curves, and the gain by summing scans."""

from pathlib import Path
from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from compute.signal.detection.false_alarms import FalseAlarms
from validation.passive_detection.case import (
    AVERAGED_RATE,
    LIGHT_ELECTRONS,
    averaged_scenes,
    curve,
)
from validation.passive_detection.detection_rates import (
    FALSE_ALARMS,
    LINES,
    PIXELS,
    SIGNAL_TO_BACKGROUND,
    Scene,
    Share,
    by_filter,
    by_pixel,
    filter_detection_probability,
    line_filter,
    pixel_detection_probability,
    pixel_threshold,
)

# Okabe and Ito's colours, which everybody can tell apart.
_COLOURS: Final = ("#D55E00", "#E69F00", "#009E73", "#0072B2")
_RATES: Final = np.geomspace(3e-4, 3.0, 25)


def draw(path: Path) -> None:
    """Draw detections over false alarms, and over the number of lines summed, as a PNG."""
    figure = Figure(figsize=(12.5, 5.0), layout="constrained")
    FigureCanvasAgg(figure)
    curves, sums = figure.subplots(1, 2, sharey=True)
    _curves(curves)
    _sums(sums)
    figure.legend(*curves.get_legend_handles_labels(), loc="outside lower left", ncols=4)
    figure.suptitle(
        f"Passive markers at {SIGNAL_TO_BACKGROUND} times their background; lines: theory, "
        f"points: {LINES} lines each, two standard errors"
    )
    figure.savefig(path, dpi=110)


def _curves(axis: Axes) -> None:
    law = FalseAlarms.of(line_filter(), PIXELS)
    thresholds = [law.threshold_sigma(float(rate)) for rate in _RATES]
    for light, colour in zip(LIGHT_ELECTRONS, _COLOURS, strict=True):
        scene = Scene(light)
        axis.plot(
            _RATES,
            [filter_detection_probability(scene, t) for t in thresholds],
            color=colour,
            label=f"{light:.0f} electrons, SNR {scene.snr:.1f}",
        )
        axis.plot(
            _RATES,
            [pixel_detection_probability(scene, pixel_threshold(float(r))) for r in _RATES],
            "--",
            color=colour,
        )
        for matched, pixel in curve(scene):
            for point, marker in ((matched, "o"), (pixel, "s")):
                alarms = point.false_alarms.measured
                across = 2.0 * float(np.sqrt(alarms / LINES))
                _point(axis, alarms, point.detections, marker, colour, min(across, 0.9 * alarms))
    axis.set(
        xscale="log",
        xlim=(_RATES[0], _RATES[-1]),
        ylim=(0.0, 1.02),
        xlabel="false alarms per line",
        ylabel="share of markers found",
        title="one line; matched filter (full), single pixels (dashed)",
    )
    axis.set_xticks(FALSE_ALARMS)
    axis.grid(alpha=0.3)


def _sums(axis: Axes) -> None:
    lines = np.geomspace(1.0, 300.0, 25).round().astype(int)
    some = next(iter(averaged_scenes().values()))
    matched = by_filter(some, AVERAGED_RATE).threshold_sigma
    single = pixel_threshold(AVERAGED_RATE)
    sums = [Scene(some.background_electrons, int(n)) for n in lines]
    axis.plot(
        lines,
        [filter_detection_probability(scene, matched) for scene in sums],
        color=_COLOURS[3],
        label="matched filter",
    )
    axis.plot(
        lines,
        [pixel_detection_probability(scene, single) for scene in sums],
        "--",
        color=_COLOURS[0],
        label="single pixels",
    )
    for number, scene in averaged_scenes().items():
        _point(axis, number, by_filter(scene, AVERAGED_RATE).detections, "o", _COLOURS[3])
        _point(axis, number, by_pixel(scene, AVERAGED_RATE).detections, "s", _COLOURS[0])
    axis.set(
        xscale="log",
        xlabel="lines summed",
        title=f"sums of lines of {some.background_electrons:.0f} electrons, "
        f"{AVERAGED_RATE:g} false alarms per line",
    )
    axis.grid(alpha=0.3)
    axis.legend(fontsize="small")


def _point(
    axis: Axes, position: float, share: Share, marker: str, colour: str, across: float = 0.0
) -> None:
    error = 2.0 * np.sqrt(share.measured * (1.0 - share.measured) / LINES)
    # None at all has no place on a logarithmic axis.
    if position > 0.0:
        axis.errorbar(position, share.measured, error, across or None, marker, color=colour, ms=4)
