"""Figure of case interpolators: errors of maps by pitch, one panel for each noise."""

from pathlib import Path
from typing import Final

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from validation.interpolators.case import METHODS, NOISES_PX, all_comparisons

_MARKERS: Final = dict(zip(METHODS, ("s", "^", "o"), strict=True))


def draw(path: Path) -> None:
    """Write the picture as a PNG."""
    found, _ = all_comparisons()
    figure = Figure(figsize=(10.0, 3.6), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(1, len(NOISES_PX), sharey=True)
    for panel, noise in zip(axes, NOISES_PX, strict=True):
        here = sorted((one for one in found if one.noise_px == noise), key=lambda one: one.pitch_mm)
        for method in METHODS:
            panel.loglog(
                [one.pitch_mm for one in here],
                [one.rms_px[method] for one in here],
                marker=_MARKERS[method],
                label=method,
            )
        panel.axhline(noise, color="grey", linestyle=":", linewidth=1.0)
        panel.set_title(f"nodes' noise {noise:g} px (dotted)", fontsize=10)
        pitches = sorted({one.pitch_mm for one in here})
        panel.set_xticks(pitches, [f"{pitch:.0f}" for pitch in pitches])
        panel.set_xticks([], minor=True)
        panel.set_xlabel("pitch [mm]")
        panel.grid(visible=True, which="both", alpha=0.25)
    axes[0].set_ylabel("RMS error of the correction [px]")
    axes[0].legend(frameon=False)
    figure.savefig(path, dpi=150)
