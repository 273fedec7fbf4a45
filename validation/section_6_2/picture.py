"""Figure of case section-6.2: Figures 6.7 and 6.8, and the tracks."""

from pathlib import Path
from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from compute.camera.stack import CameraStack
from compute.tracking.settings import TrackerSettings
from validation.section_6.rotating_bar import cameras
from validation.section_6_2.scene import SEED, scans
from validation.section_6_2.three_passive_markers import AFTER, BEFORE, MODEL, our_tracks, points
from validation.section_6_2.track_quality import MIN_SCANS, thesis_tracks

SENSOR: Final = 1


def draw(path: Path) -> None:
    """Draw one sensor's points before and after [6.5], the thesis's tracks and ours."""
    figure = Figure(figsize=(13.0, 8.5), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(2, 2, sharex=True, sharey=True)
    _points(axes[0, 0], BEFORE, "Figure 6.7: before weighted elimination")
    _points(axes[0, 1], AFTER, "Figure 6.8: after it")
    _thesis(axes[1, 0])
    _ours(axes[1, 1])
    for axis in axes[-1]:
        axis.set_xlabel("scan")
    for axis in axes[:, 0]:
        axis.set_ylabel("position [px]")
    figure.savefig(path, dpi=110)


def _points(axis: Axes, kind: str, title: str) -> None:
    position = points(kind, SEED)[SENSOR]
    scan = np.broadcast_to(np.arange(len(position))[:, None], position.shape)
    axis.plot(scan.ravel(), position.ravel(), ".", color="tab:blue", ms=2)
    axis.set(title=f"{title}, sensor {SENSOR + 1}", ylim=(0.0, cameras()[SENSOR].pixels))


def _truth(axis: Axes) -> None:
    truth = scans(SEED).truth.position_px[:, :, SENSOR]
    axis.plot(truth, color="0.8", lw=4)


def _thesis(axis: Axes) -> None:
    _truth(axis)
    for track in thesis_tracks(points(AFTER, SEED)[SENSOR], MODEL):
        if track.life >= MIN_SCANS:
            axis.plot(track.first_scan + np.arange(len(track.position_px)), track.position_px, lw=1)
    axis.set(title=f"the probabilistic model after [6.5]: tracks seen {MIN_SCANS} times and more")


def _ours(axis: Axes) -> None:
    _truth(axis)
    found = our_tracks(TrackerSettings(), SEED)
    stack = CameraStack.of(list(cameras()))
    for marker in range(found.identity.shape[1]):
        along = stack.project(found.position_mm[:, marker])[:, SENSOR]
        for number in np.unique(found.identity[:, marker]):
            if number > 0:
                own = found.identity[:, marker] == number
                axis.plot(np.where(own, along, np.nan), lw=1)
    axis.set(title="ours in space, projected")
