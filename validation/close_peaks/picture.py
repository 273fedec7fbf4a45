"""Figure of case close-peaks: errors of three methods by distance, and one fitted scan."""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from compute.signal.fit.fit_settings import FitSettings
from compute.signal.fit.group_fit import fit_scan
from validation.close_peaks.case import CUT_LINES, LINES
from validation.close_peaks.monte_carlo import (
    LIGHTS,
    RATIOS,
    READ_NOISE,
    SEPARATIONS,
    WIDTH_PX,
    Pair,
    pair_figures,
)
from validation.synthetic_scans import MIDDLE_PX, expose, gaussian_electrons, line_noise


def draw(path: Path) -> None:
    """Draw RMS errors against distance, equal and 1:5, and a pair with its residuals, as a PNG."""
    figure = Figure(figsize=(12.5, 4.8), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(1, len(RATIOS) + 1)
    for axis, ratio in zip(axes, RATIOS, strict=False):
        _errors(axis, ratio)
    axes[0].legend()
    _line(axes[-1])
    figure.suptitle(f"Two Gaussian lines of {WIDTH_PX:g} px, read noise {READ_NOISE:g} electrons")
    figure.savefig(path, dpi=120)


def _errors(axis: Axes, ratio: int) -> None:
    light = LIGHTS[-1]
    pairs = [pair_figures(Pair(light, ratio, apart), LINES, CUT_LINES) for apart in SEPARATIONS]
    for name, mark in (("known", "o-"), ("valley", "v-"), ("slopes", "^-")):
        rms = [getattr(pair, name).rms_px[0] for pair in pairs]
        label = {"known": "joint fit", "valley": "valley cut", "slopes": "slope extension"}[name]
        axis.plot(SEPARATIONS, rms, mark, label=label, markersize=5)
    axis.plot(SEPARATIONS, [pair.bound_px[0] for pair in pairs], "k--", label="bound")
    axis.set(
        yscale="log",
        xlabel="distance [deviations]",
        ylabel="RMS error of the fainter [px]",
        title=f"1:{ratio}, {light:.0e} electrons in the fainter",
    )


def _line(axis: Axes) -> None:
    rng = np.random.default_rng(6)
    position = MIDDLE_PX + 0.3 + WIDTH_PX * np.array([[-1.0, 1.0]])
    line = expose(gaussian_electrons(position, WIDTH_PX, (1e4, 1e4)), READ_NOISE, rng)[0]
    settings = FitSettings(width_px=WIDTH_PX, width_log_sigma=0.0)
    (group,) = fit_scan(line, settings, line_noise(READ_NOISE))
    pixel = group.first_px + np.arange(len(group.values))
    axis.step(pixel, group.values, where="mid", color="0.5", label="counts")
    axis.plot(pixel, group.model, "o-", markersize=3, label="joint fit")
    for true, found in zip(position[0], group.position_px, strict=True):
        axis.axvline(true, color="black", linewidth=0.8)
        axis.axvline(found, color="tab:red", linestyle="--", linewidth=0.8)
    beside = axis.twinx()
    beside.bar(pixel, group.residual_sigma, color="tab:green", alpha=0.4, width=0.6)
    beside.set(ylim=(-4.0, 20.0), ylabel="residual [standard deviations]")
    axis.set(xlabel="pixel", ylabel="counts", title="2 deviations apart, 1e4 electrons each")
    axis.legend()
