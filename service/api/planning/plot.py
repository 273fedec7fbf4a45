"""Plot of a plan: maps of sigma, error over distance, readings, ghosts, accuracy budget."""

import io
from typing import Final

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, NullFormatter
from numpy.typing import NDArray
from PIL import Image

from compute.planning.plan import column_medians
from compute.planning.plan_result import AccuracyBudget, Plan

Array = NDArray[np.float64]

# Okabe and Ito's colours, told apart by colour-blind eyes; X, Y, Z also differ by marker.
_COLOURS: Final = ("#0072B2", "#E69F00", "#009E73")
_MARKERS: Final = ("o", "s", "^")
_SENSOR_COLOUR: Final = "#D55E00"
_PATTERN_COLOUR: Final = "#CC79A7"
_BUDGET_COLOURS: Final = (
    "#999999", "#F0E442", "#000000", "#CC79A7", "#0072B2", "#E69F00", "#009E73", "#D55E00",
    "#56B4E9",
)  # fmt: skip
_MAP: Final = "cividis"
_DPI: Final = 110


def draw_plan(plan: Plan) -> bytes:
    """Return the picture of a plan as PNG.

    No state of pyplot's is used, so that it may be called in any thread.
    """
    with mpl.rc_context({"font.size": 9, "axes.titlesize": 10}):
        figure = Figure(figsize=(14.0, 17.0), layout="constrained")
        FigureCanvasAgg(figure)
        figure.suptitle(f"{plan.profile_id}: {plan.title}", fontsize=13)
        rows = figure.add_gridspec(3, 1, height_ratios=(2.2, 1.0, 1.0))
        maps, below, last = (figure.add_subfigure(rows[row]) for row in range(3))
        _maps(maps.subplots(3, 2), plan)
        distance, readings, ghosts = below.subplots(1, 3)
        _against_distance(distance, plan)
        _readings(readings, plan)
        _ghosts(ghosts, plan)
        sizes, shares = last.subplots(1, 2)
        _budget(sizes, shares, plan.budget)
        drawn, small = io.BytesIO(), io.BytesIO()
        figure.savefig(drawn, format="png", dpi=_DPI)
    # A palette of 256 colours takes less than half of the bytes.
    Image.open(drawn).convert("RGB").quantize(256).save(small, "png", optimize=True)
    return small.getvalue()


def _values(plan: Plan, name: str) -> Array:
    """Return a figure of the points on the grid, shape (*grid, 3); NaN where there is none."""
    rows = [getattr(point, name) for point in plan.points]
    found = np.array([(np.nan,) * 3 if row is None else row for row in rows], dtype=np.float64)
    return found.reshape(*plan.grid, 3)


def _maps(axes: NDArray[np.object_], plan: Plan) -> None:
    """Draw sigma over a horizontal and a vertical section through the centre."""
    deviation = _values(plan, "sd_mm") * 1e3
    places = _values(plan, "position_mm")
    middle = [count // 2 for count in plan.grid]
    sections = (
        ("horizontal section", "X [mm]", 0, deviation[:, middle[1]], places[:, middle[1]]),
        ("vertical section", "Y [mm]", 1, deviation[middle[0]], places[middle[0]]),
    )
    for column, (title, label, across, section, where) in enumerate(sections):
        for axis in range(3):
            panel = axes[axis, column]
            _map(panel, where[..., 2], where[..., across], section[..., axis])
            _device(panel, plan, across)
            panel.set(
                title=f"noise, standard deviation of {'XYZ'[axis]} [µm], {title}",
                xlabel="Z, distance [mm]" if axis == 2 else "",
                ylabel=label,
            )


def _map(panel: Axes, distance: Array, across: Array, values: Array) -> None:
    known = np.ma.masked_invalid(values)
    if known.count() == 0:
        panel.text(0.5, 0.5, "no position here", ha="center", transform=panel.transAxes)
        return
    low, high = float(known.min()), float(known.max())
    if high - low <= 1e-9 * high:  # one value everywhere
        low, high = 0.99 * low, 1.01 * high
    levels = list(MaxNLocator(9).tick_values(low, high))
    drawn = panel.contourf(distance, across, known, levels=levels, cmap=_MAP)
    figure = panel.get_figure()
    assert figure is not None
    figure.colorbar(drawn, ax=panel, pad=0.01, fraction=0.05)


def _device(panel: Axes, plan: Plan, across: int) -> None:
    """Draw where the sensors are, and the volume's outline."""
    positions = np.array([sensor.position_mm for sensor in plan.sensors])
    panel.plot(
        positions[:, 2], positions[:, across], ">", color=_SENSOR_COLOUR, ms=7, clip_on=False,
        zorder=3,
    )  # fmt: skip
    centre, size = np.array(plan.volume.centre_mm), np.array(plan.volume.size_mm)
    low, high = centre - size / 2.0, centre + size / 2.0
    panel.plot(
        [low[2], high[2], high[2], low[2], low[2]],
        [low[across], low[across], high[across], high[across], low[across]],
        color="0.4",
        lw=1.0,
    )
    panel.set_aspect("equal", "box")
    panel.margins(0.04, 0.1)


def _against_distance(panel: Axes, plan: Plan) -> None:
    """Draw the median sigma in each plane of the grid against its distance."""
    distance = _values(plan, "position_mm")[0, 0, :, 2]
    for name, style in (("sd_mm", "-"), ("centroid_sd_mm", "--")):
        for axis, values in enumerate(_medians(_values(plan, name))):
            if np.isfinite(values).any():
                panel.plot(
                    distance, values * 1e3, style, color=_COLOURS[axis], marker=_MARKERS[axis],
                    ms=4, label=f"{'XYZ'[axis]}" if style == "-" else None,
                )  # fmt: skip
    panel.plot([], [], "-", color="0.3", label="bound of the readings")
    panel.plot([], [], "--", color="0.3", label="centre of gravity")
    panel.set(
        yscale="log", xlabel="Z, distance [mm]", ylabel="deviation [µm]",
        title="noise against distance (median of each plane)",
    )  # fmt: skip
    low, high = panel.get_ylim()
    panel.set_ylim(low, high * (high / low) ** 0.3)  # room for the legend
    panel.yaxis.set_major_formatter(_plain)
    if high < 30.0 * low:
        panel.yaxis.set_minor_formatter(_plain)
    else:
        panel.yaxis.set_minor_formatter(NullFormatter())
    panel.tick_params(axis="y", which="minor", labelsize=7)
    panel.grid(axis="y", which="both", color="0.93")
    panel.legend(fontsize=8, ncols=2, loc="upper left")


def _medians(values: Array) -> list[Array]:
    """Return the medians over X and Y of each axis against Z, NaN where nothing is known."""
    planes = values.reshape(-1, *values.shape[2:])
    return [column_medians(planes[..., axis]) for axis in range(3)]


def _readings(panel: Axes, plan: Plan) -> None:
    """Draw each sensor's bound, centre of gravity, fixed pattern and distortion."""
    rows = np.arange(len(plan.sensors))
    for label, marker, colour, values in (
        ("bound, noise", "o", _COLOURS[0], [sensor.bound_px for sensor in plan.sensors]),
        ("centre of gravity", "s", _COLOURS[1], [s.centroid_px for s in plan.sensors]),
        ("fixed pattern", "D", _PATTERN_COLOUR, [s.fixed_pattern_px for s in plan.sensors]),
        ("distortion, uncorrected", "^", _COLOURS[2], [s.misfit_px for s in plan.sensors]),
    ):
        known = np.array([np.nan if value is None else value for value in values])
        if np.isfinite(known).any():
            panel.plot(known, rows, marker, color=colour, label=label)
    panel.set(
        xscale="log", xlabel="[px]", title="readings: median noise and pattern, RMS distortion",
        ylim=(len(rows) - 0.4, -1.75),
    )  # fmt: skip
    names = [
        f"{s.name}\n{100 * s.saturated:.2g} % full" if s.saturated else s.name for s in plan.sensors
    ]
    panel.set_yticks(rows, names)
    panel.grid(axis="x", color="0.9")
    panel.legend(fontsize=8, ncols=2, loc="upper center", columnspacing=0.8, handletextpad=0.2)


def _ghosts(panel: Axes, plan: Plan) -> None:
    panel.set(title="markers lit together: wrong combinations", xlabel="markers")
    if not plan.ghosts:
        text = "one marker" if len(plan.rates) == 1 else "not counted, see the notes"
        panel.text(0.5, 0.5, text, ha="center", transform=panel.transAxes)
        panel.set_axis_off()
        return
    markers = [ghost.markers for ghost in plan.ghosts]
    expected = np.array([ghost.expected for ghost in plan.ghosts])
    error = np.array([ghost.standard_error for ghost in plan.ghosts])
    wrong = [ghost.candidates - ghost.markers for ghost in plan.ghosts]
    panel.plot(markers, wrong, "--", color="0.4", label="all wrong combinations")
    shown = expected > 0.0
    if shown.any():
        panel.errorbar(
            np.array(markers)[shown], expected[shown],
            yerr=[np.minimum(error, 0.9 * expected)[shown], error[shown]],
            fmt="o-", color=_COLOURS[0], ms=4, capsize=2, label="that look like markers",
        )  # fmt: skip
    panel.axhline(1.0, color="0.8", lw=0.8)
    panel.set(xscale="log", yscale="log", ylabel="expected number in one exposure")
    ticks = [count for count in (2, 3, 5, 8, 12, 20, 32, 64) if count <= max(markers)]
    panel.set_xticks(ticks, [str(count) for count in ticks])
    panel.xaxis.set_minor_formatter(NullFormatter())
    panel.legend(fontsize=8, loc="upper left")


def _budget(sizes: Axes, shares: Axes, budget: AccuracyBudget | None) -> None:
    """Draw the contributions' sizes, and their shares of the variance against distance."""
    if budget is None:
        for panel in (sizes, shares):
            panel.text(0.5, 0.5, "no budget, see the notes", ha="center", transform=panel.transAxes)
            panel.set_axis_off()
        return
    listed = [one for one in budget.contributions if one.rms_mm > 0.0]
    names = [f"{one.name}{', assumed' if one.assumed else ''}" for one in listed]
    counted = [one for one in listed if one.counted]
    colours = dict(zip((one.name for one in counted), _BUDGET_COLOURS, strict=False))
    sizes.barh(
        range(len(listed)),
        [one.rms_mm for one in listed],
        color=[colours.get(one.name, "none") for one in listed],
        edgecolor=["none" if one.counted else "0.5" for one in listed],
    )
    sizes.axvline(budget.total_rms_mm, color="0.2", lw=1.0, label="total")
    sizes.set(
        xscale="log", xlabel="standard uncertainty, 3D, RMS over the volume [mm]",
        title=f"accuracy budget: {budget.dominant} dominates (outlined: not in the total)",
    )  # fmt: skip
    sizes.set_yticks(range(len(listed)), names)
    sizes.invert_yaxis()
    sizes.grid(axis="x", color="0.9")
    sizes.set_axisbelow(True)
    sizes.legend(fontsize=8, loc="lower right")

    distances, total = np.array(budget.distances_mm), np.array(budget.total_by_distance_mm)
    width = 0.7 * float(np.diff(distances).min()) if len(distances) > 1 else 100.0
    bottom = np.zeros(len(distances))
    for one in counted:
        height = 100.0 * np.square(np.array(one.by_distance_mm) / total)
        shares.bar(
            distances, height, width, bottom, color=colours[one.name],
            label=one.name if height.max() >= 1.0 else None,
        )  # fmt: skip
        bottom += height
    for distance, value in zip(distances, total, strict=True):
        shares.text(distance, 101.0, f"{value:.2g} mm", ha="center", fontsize=8)
    shares.set(
        xlabel="Z, distance [mm]", ylabel="share of the variance [%]", ylim=(0.0, 108.0),
        title="what dominates where (total on top)",
    )  # fmt: skip
    shares.legend(fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5))


def _plain(value: float, _: float) -> str:
    """Write a tick of a logarithmic axis as a number; only at 1, 2 and 5 of each decade."""
    first = f"{value:.0e}"[0]
    return f"{value:g}" if first in "125" else ""
