"""Figure of case peak-efficiency: RMS errors over the bound, by width."""

from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from validation.peak_efficiency.case import LINES
from validation.peak_efficiency.monte_carlo import (
    EDGE,
    FITTED,
    GRAVITY,
    KNOWN_WIDTH,
    LIGHTS,
    WIDTHS_PX,
    Setting,
    efficiency,
)

_READ_NOISE = 20.0
_MARKS = {KNOWN_WIDTH: "o-", FITTED: "s--", GRAVITY: "v-", EDGE: "^-"}


def draw(path: Path) -> None:
    """Draw the errors of four estimators for three amounts of light, as a PNG."""
    figure = Figure(figsize=(12.5, 4.4), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(1, len(LIGHTS), sharey=True)
    for axis, light in zip(axes, LIGHTS, strict=True):
        lines = [efficiency(Setting(width, light, _READ_NOISE), LINES) for width in WIDTHS_PX]
        for name, mark in _MARKS.items():
            ratio = [line.errors[name].rms_px / line.strict_px for line in lines]
            axis.plot(WIDTHS_PX, ratio, mark, label=name, markersize=5)
        axis.axhline(1.0, color="black", linewidth=0.8)
        bounds = np.array([line.strict_px for line in lines])
        axis.set(
            xlabel="deviation of the line [px]",
            title=f"{light:.0e} electrons: bound {bounds[0]:.4f} to {bounds[-1]:.3f} px",
            yscale="log",
        )
    axes[0].set_ylabel("RMS error / Cramer-Rao bound")
    axes[0].set_yticks([1, 2, 5, 10], ["1", "2", "5", "10"])
    axes[0].legend()
    figure.suptitle(f"One line at every place within a pixel, read noise {_READ_NOISE:g} electrons")
    figure.savefig(path, dpi=120)
