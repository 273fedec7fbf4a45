"""Figure of case marker-capacity: shares of exposures by the number of markers."""

from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from compute.planning.ghost_points import intersecting_points
from validation.marker_capacity.monte_carlo import MARKERS, SCENES, Scene, capacity
from validation.marker_capacity.rigs import RIGS


def draw(path: Path) -> None:
    """Draw the share of markers resolved, by configuration, for each scene, as a PNG."""
    figure = Figure(figsize=(12.5, 8.0), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(2, 2, sharex=True, sharey=True)
    for axis, scene in zip(axes.flat, SCENES, strict=True):
        _shares(axis, scene)
    axes[0, 0].legend(fontsize="small")
    beside = axes[0, 0].twinx()
    beside.plot(MARKERS, [intersecting_points(count) for count in MARKERS], "k:")
    beside.set(yscale="log", ylabel="points that lines meet in, [2.15] (dotted)")
    figure.suptitle("Frames with every marker grouped rightly (lines) and wrong unmarked (crosses)")
    figure.savefig(path, dpi=110)


def _shares(axis: Axes, scene: Scene) -> None:
    for index, rig in enumerate(RIGS):
        shares = [capacity(index, scene, count) for count in MARKERS]
        (line,) = axis.plot(
            MARKERS, [share.resolved for share in shares], "o-", markersize=3, label=rig().name
        )
        wrong = [(count, share.wrong) for count, share in zip(MARKERS, shares, strict=True)]
        marked = [(count, share) for count, share in wrong if share > 0.0]
        axis.plot(
            [count for count, _ in marked],
            [share for _, share in marked],
            "x",
            color=line.get_color(),
        )
    axis.set(
        xlabel="markers lit at once",
        ylabel="share of frames",
        title=scene.label,
        ylim=(-0.03, 1.03),
    )
