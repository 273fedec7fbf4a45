"""Plot of the control charts of a device."""

import io
from collections.abc import Sequence
from typing import Final

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.dates import AutoDateLocator, ConciseDateFormatter, date2num
from matplotlib.figure import Figure

from service.api.quality.schema import Chart, ChartPoint, Quality

# Okabe and Ito's colours, told apart by colour-blind eyes; signals also differ by marker.
_VALUE: Final = "#0072B2"
_AVERAGE: Final = "#009E73"
_SIGNALS: Final = {"jump": ("#D55E00", "s"), "drift": ("#E69F00", "^")}
_DPI: Final = 110


def plot_control_charts(found: Quality) -> bytes:
    """Return the charts as PNG; no state of pyplot's is used."""
    with mpl.rc_context({"font.size": 9, "axes.titlesize": 10, "text.parse_math": False}):
        rows = max(1, len(found.charts))
        figure = Figure(figsize=(9.0, 1.0 + 2.0 * rows), layout="constrained")
        FigureCanvasAgg(figure)
        title = f"{found.device_id}, {found.calibration_id or 'no calibration'}"
        figure.suptitle(f"{title}: {found.recommendation}", fontsize=12)
        axes = figure.subplots(rows, 1, squeeze=False)[:, 0]
        for one, chart in zip(axes, found.charts, strict=False):
            _draw(one, chart)
        if not found.charts:
            axes[0].set_axis_off()
            axes[0].text(0.5, 0.5, "nothing was watched or checked yet", ha="center", va="center")
        drawn = io.BytesIO()
        figure.savefig(drawn, format="png", dpi=_DPI)
    return drawn.getvalue()


def _times(points: Sequence[ChartPoint]) -> list[float]:
    return [float(date2num(point.measured_at)) for point in points]  # type: ignore[no-untyped-call]


def _draw(axes: Axes, chart: Chart) -> None:
    at = _times(chart.points)
    axes.plot(at, [point.value for point in chart.points], "o-", color=_VALUE, markersize=3,
              linewidth=0.6, label="value")  # fmt: skip
    judged = chart.points[chart.baseline :]
    axes.plot(_times(judged), [point.average for point in judged],
              color=_AVERAGE, linewidth=1.2, label="weighted average")  # fmt: skip
    for name, (colour, marker) in _SIGNALS.items():
        there = [point for point in chart.points if point.signal == name]
        if there:
            axes.plot(_times(there), [point.value for point in there], marker,
                      color=colour, markersize=6, label=name)  # fmt: skip
    if chart.centre is not None:
        axes.axhline(chart.centre, color="0.4", linewidth=0.8)
    for limit in (chart.lower, chart.upper):
        if limit is not None:
            axes.axhline(limit, color="0.4", linewidth=0.8, linestyle="--")
    axes.set_title(f"{chart.series}: {chart.meaning}", loc="left")
    axes.set_ylabel(chart.unit)
    axes.ticklabel_format(axis="y", useOffset=False)
    locator = AutoDateLocator()  # type: ignore[no-untyped-call]
    axes.xaxis.set_major_locator(locator)
    form = ConciseDateFormatter(locator)  # type: ignore[no-untyped-call]
    axes.xaxis.set_major_formatter(form)
    axes.legend(loc="upper left", fontsize=7, ncols=4)
