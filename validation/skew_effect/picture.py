"""Figure of case skew-effect: residuals of three models over both field angles."""

from pathlib import Path

import numpy as np
from matplotlib import colors
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from validation.aberrations.thesis_lens import ROW, stopped_lens
from validation.skew_effect.case import MODELS
from validation.skew_effect.traced_readings import (
    FIELD_U,
    FIELD_V,
    field_points,
    fitted,
    left_out_px,
    traced_readings,
)

_SHOWN = ("7 parameters", "u^3 u^5 u^7", "u,v order 5")
_DISTANCE_MM = 1500.0


def draw(path: Path) -> None:
    """Draw the errors over the field at 1.5 m, of fits to the whole field, as a PNG."""
    assembly = stopped_lens(4.0)
    known = traced_readings(assembly, field_points((15, 9, 4)))
    u, v = np.meshgrid(np.linspace(-FIELD_U, FIELD_U, 31), np.linspace(-FIELD_V, FIELD_V, 17))
    points = _DISTANCE_MM * np.stack([u.ravel(), v.ravel(), np.ones(u.size)], axis=1)
    shown = traced_readings(assembly, points)
    # A pair of angles whose line falls beside the row has no error, and is left white.
    place = {tuple(point): number for number, point in enumerate(points.tolist())}
    index = [place[tuple(point)] for point in shown.points_mm.tolist()]
    figure = Figure(figsize=(12.5, 4.6), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(1, 3, sharey=True)
    for axis, name in zip(axes, _SHOWN, strict=True):
        fit = fitted(assembly, known, MODELS[name])
        error = np.full(u.size, np.nan)
        error[index] = left_out_px(fit, shown)
        largest = float(np.nanmax(np.abs(error)))
        scale, unit = (1000.0, "mpx") if largest < 0.1 else (1.0, "px")
        limit = largest * scale
        drawn = axis.pcolormesh(
            np.degrees(np.arctan(u)),
            np.degrees(np.arctan(v)),
            scale * error.reshape(u.shape),
            cmap="PuOr",
            norm=colors.Normalize(-limit, limit),
            shading="gouraud" if not np.isnan(error).any() else "nearest",
        )
        figure.colorbar(drawn, ax=axis, orientation="horizontal", label=f"reading - model [{unit}]")
        axis.set(
            xlabel="angle along the row, arctan u [deg]",
            title=f"{name}\nRMS {fit.rms_px:.2g} px over 1 to 2 m",
        )
        axis.set_aspect("equal")
    axes[0].set_ylabel("angle along the lens's axis, arctan v [deg]")
    figure.suptitle(
        f"What models leave of the distortion: lens of section 3.4, slit of 4 mm on its plane "
        f"face, {ROW.count} px of {ROW.pitch_um:g} um, at 1.5 m"
    )
    figure.savefig(path, dpi=120)
