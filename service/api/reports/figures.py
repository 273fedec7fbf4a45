"""Figures of a calibration report, as SVG or PNG."""

import io
from collections.abc import Callable, Sequence
from typing import Any, Final, Literal

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from service.api.reports.content import ReportContent

Array = NDArray[np.float64]

# Okabe and Ito's colours, told apart by colour-blind eyes; series also differ by marker.
COLOURS: Final = ("#0072B2", "#E69F00", "#009E73", "#D55E00", "#CC79A7", "#56B4E9", "#000000")
MARKERS: Final = ("o", "s", "^", "v", "D", "P", "X")
_MAP: Final = "cividis"
_DPI: Final = 110
_MARKER_COUNT_THRESHOLD: Final = 800
"""Points from which a picture is drawn as pixels also within SVG."""
_GRID_STEPS: Final = 21


Kind = Literal["svg", "png"]


def draw(figure: str, content: ReportContent, kind: Kind) -> bytes | None:
    """Return one of ``FIGURES``; None where the content has nothing for it."""
    drawn = draw_as(figure, content, (kind,))
    return None if drawn is None else drawn[kind]


def draw_as(figure: str, content: ReportContent, kinds: Sequence[Kind]) -> dict[Kind, bytes] | None:
    """Return one of ``FIGURES``, drawn once, in several formats.

    No state of pyplot's is used. Names are drawn as they are: no dollar sign begins a formula.
    """
    settings: dict[Any, Any] = {"font.size": 9, "axes.titlesize": 10, "text.parse_math": False}
    found: dict[Kind, bytes] = {}
    with mpl.rc_context(settings):
        made = FIGURES[figure](content)
        if made is None:
            return None
        FigureCanvasAgg(made)
        for kind in kinds:
            drawn = io.BytesIO()
            metadata = {"Date": None, "Creator": None} if kind == "svg" else None
            made.savefig(drawn, format=kind, dpi=_DPI, metadata=metadata)
            found[kind] = drawn.getvalue()
    return found


def _colour(number: int) -> str:
    return COLOURS[number % len(COLOURS)]


def _dots(axes: Axes, x: Array, y: Array, number: int, label: str | None = None) -> None:
    axes.plot(
        x, y, MARKERS[number % len(MARKERS)], color=_colour(number), markersize=3, alpha=0.8,
        label=label, rasterized=len(x) > _MARKER_COUNT_THRESHOLD,
    )  # fmt: skip


def _residuals(
    content: ReportContent, title: str, columns: dict[str, Array], band: Array | None = None
) -> Figure | None:
    """Draw residuals over columns of x values (N, 1) or (N, S), in a row for each sensor."""
    residuals = content.residuals_px
    if not np.isfinite(residuals).any():
        return None
    count = len(content.sensors)
    figure = Figure(figsize=(9.0, 1.0 + 1.3 * count), layout="constrained")
    axes = figure.subplots(count, len(columns), squeeze=False, sharey="row", sharex="col")
    figure.suptitle(title)
    for column, (label, values) in enumerate(columns.items()):
        x = np.broadcast_to(values, residuals.shape)
        for number, name in enumerate(content.sensors):
            one = axes[number, column]
            one.axhline(0.0, color="0.6", linewidth=0.6)
            if band is not None:
                one.fill_between(x[:, number], -band[:, number], band[:, number], color="0.9")
            _dots(one, x[:, number], residuals[:, number], number)
            if column == 0:
                one.set_ylabel(f"{name}\n[px]")
        axes[-1, column].set_xlabel(label)
    return figure


def residuals_order(content: ReportContent) -> Figure | None:
    """Residuals in the order of measurement: drift and jumps show here."""
    title = "Residuals in the order of measurement"
    x = {"number of the point": _numbers(content)[:, None]}
    return _residuals(content, title, x, 2.0 * content.reading_sigma_px)


def residuals_position(content: ReportContent) -> Figure | None:
    """Residuals against X, Y, Z: what the model does not describe shows as a curve."""
    x = {f"{name} [mm]": content.points_mm[:, [axis]] for axis, name in enumerate("XYZ")}
    return _residuals(content, "Residuals over position", x)


def residuals_pixels(content: ReportContent) -> Figure | None:
    """Residuals against the reading: errors of the pixels and of distortion along the row."""
    return _residuals(content, "Residuals over the pixels", {"reading [px]": content.repaired_px})


def _numbers(content: ReportContent) -> Array:
    return np.arange(1, len(content.points_mm) + 1, dtype=np.float64)


def residuals_histogram(content: ReportContent) -> Figure | None:
    """Histogram of residuals over sigma, with the normal distribution."""
    ratio = content.residuals_px / content.reading_sigma_px
    found = ratio[np.isfinite(ratio)]
    if not len(found):
        return None
    figure = Figure(figsize=(9.0, 3.2), layout="constrained")
    axes = figure.subplots()
    reach = max(4.0, min(12.0, float(np.abs(found).max())))
    edges = np.linspace(-reach, reach, 41)
    axes.hist(
        np.clip(found, -reach, reach), edges.tolist(), density=True, color=COLOURS[0], alpha=0.6
    )
    x = np.linspace(-reach, reach, 201)
    axes.plot(x, np.exp(-(x**2) / 2) / np.sqrt(2 * np.pi), color="k", label="normal distribution")
    axes.set_xlabel("residual over its deviation (beyond the ends: in the last bars)")
    axes.set_ylabel("density")
    axes.set_title(f"{len(found)} residuals, root mean square {np.sqrt((found**2).mean()):.2f}")
    axes.legend(loc="upper right")
    return figure


def coverage(content: ReportContent) -> Figure | None:
    """Draw the control points on the pixels, in the field and in depth, for each sensor."""
    if not len(content.points_mm):
        return None
    count = len(content.sensors)
    figure = Figure(figsize=(9.0, 1.0 + 1.7 * count), layout="constrained")
    axes = figure.subplots(count, 3, squeeze=False, sharex="col")
    figure.suptitle("Coverage")
    u, v = content.stack.field_angles(content.points_mm)
    for number, model in enumerate(content.calibration.models):
        seen = np.isfinite(content.repaired_px[:, number])
        pixels, field, depth = axes[number]
        pixels.hist(
            content.repaired_px[seen, number], np.linspace(-0.5, model.pixels - 0.5, 33),
            color=_colour(number),
        )  # fmt: skip
        pixels.set_ylabel(f"{model.name}\npoints")
        across, name = v[seen, number], "v = y/z"
        if model.distortion is None and len(across):
            # No reading depends on where along its slit the sensor is: v's zero is not known.
            across, name = across - across.mean(), "v less its mean"
        _dots(field, u[seen, number], across, number)
        field.set_ylabel(name)
        z = content.points_mm[seen] @ model.rotation[2] + model.offset_z_mm
        depth.hist(z, 20, color=_colour(number))
    axes[-1, 0].set_xlabel("reading [px]")
    axes[-1, 1].set_xlabel("u = x/z")
    axes[-1, 2].set_xlabel("depth [mm]")
    return figure


def point_errors(content: ReportContent) -> Figure | None:
    """Errors of the control points along X, Y, Z: fitted, and predicted without the point."""
    series: list[tuple[str, Array]] = []
    if np.isfinite(content.fitted_errors_mm).any():
        over = content.count_readings(content.fitted_errors_mm)
        series.append((f"fitted, {over} readings", content.fitted_errors_mm))
    for check in content.calibration.cross_validation:
        rows = content.left_out_mm(check)
        if len(rows) == len(content.points_mm):
            label = "left out one by one" if check.scheme == "points" else "left out in blocks"
            series.append((f"{label}, {content.count_readings(rows)} readings", rows))
    if not series:
        return None
    figure = Figure(figsize=(9.0, 5.0), layout="constrained")
    axes = figure.subplots(3, 1, sharex=True)
    figure.suptitle("Control points: reconstructed less given")
    order = _numbers(content)
    for axis, name in enumerate("XYZ"):
        axes[axis].axhline(0.0, color="0.6", linewidth=0.6)
        axes[axis].set_ylabel(f"{name} [mm]")
        for number, (label, errors) in enumerate(series):
            _dots(axes[axis], order, errors[:, axis], number, label)
    axes[0].legend(ncols=3, loc="upper right")
    axes[-1].set_xlabel("number of the point")
    return figure


def uncertainty(content: ReportContent) -> Figure | None:
    """Deviation of a point over two sections through the middle of the control points' box."""
    if content.volume_mm is None or len(content.sensors) < 3:
        return None
    low, high = content.volume_mm
    figure = Figure(figsize=(9.0, 4.0), layout="constrained")
    axes = figure.subplots(1, 2)
    figure.suptitle("Deviation of a point, of noise and calibration together [mm]")
    middle = (low + high) / 2
    images = []
    for place, (across, up) in zip(axes, ((0, 1), (0, 2)), strict=True):
        x, y = (np.linspace(low[axis], high[axis], _GRID_STEPS) for axis in (across, up))
        points = np.tile(middle, (_GRID_STEPS * _GRID_STEPS, 1))
        grid_x, grid_y = np.meshgrid(x, y)
        points[:, across], points[:, up] = grid_x.ravel(), grid_y.ravel()
        total = np.linalg.norm(content.uncertainty_mm(points), axis=1).reshape(
            _GRID_STEPS, _GRID_STEPS
        )
        images.append((place, x, y, total))
        fixed = 3 - across - up
        place.set_title(f"{'XYZ'[fixed]} = {middle[fixed]:.0f} mm")
        place.set_xlabel(f"{'XYZ'[across]} [mm]")
        place.set_ylabel(f"{'XYZ'[up]} [mm]")
    known = np.concatenate([total[np.isfinite(total)] for *_, total in images])
    if not len(known):
        return None
    for place, x, y, total in images:
        drawn = place.pcolormesh(
            x, y, total, cmap=_MAP, vmin=known.min(), vmax=known.max(), rasterized=True
        )
        place.set_aspect("equal")
    figure.colorbar(drawn, ax=list(axes), label="root of the summed variances [mm]")
    return figure


def comparison(content: ReportContent) -> Figure | None:
    """Differences of the parameters from another calibration, over sigma."""
    if content.compared is None:
        return None
    name, found = content.compared.name, content.compared.comparison
    rows = [row for row in found.parameters if row.sigmas is not None]
    if not rows:
        return None
    figure = Figure(figsize=(9.0, 3.4), layout="constrained")
    axes = figure.subplots()
    parameters = list(dict.fromkeys(row.parameter for row in rows))
    for number, sensor in enumerate(content.sensors):
        own = [row for row in rows if row.sensor == sensor]
        shift = 0.12 * (number - len(content.sensors) / 2)
        x = [parameters.index(row.parameter) + shift for row in own]
        signed = [float(np.copysign(row.sigmas or 0.0, row.difference)) for row in own]
        _dots(axes, np.array(x), np.array(signed), number, sensor)
    axes.axhspan(-2.0, 2.0, color="0.92")
    axes.set_xticks(range(len(parameters)), parameters, rotation=30, ha="right")
    axes.set_ylabel("difference / deviation")
    axes.set_title(f"Parameters against {name}")
    axes.legend(loc="upper right", ncols=4)
    return figure


FIGURES: Final[dict[str, Callable[[ReportContent], Figure | None]]] = {
    "residuals-order": residuals_order,
    "residuals-position": residuals_position,
    "residuals-pixels": residuals_pixels,
    "residuals-histogram": residuals_histogram,
    "coverage": coverage,
    "point-errors": point_errors,
    "uncertainty": uncertainty,
    "comparison": comparison,
}
"""By the names of the report's PNGs."""
