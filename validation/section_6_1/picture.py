"""Figure of case section-6.1: Figures 6.3, 6.5, 6.6 and 6.17, beside ours."""

from pathlib import Path
from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from validation.section_6.rotating_bar import RATE_HZ, Motion, Readings, cameras, readings
from validation.section_6_1.kinematics import by_differences, our_kinematics, true_kinematics
from validation.section_6_1.thesis_tracking import ActiveScene, differences, record, track_pair
from validation.section_6_1.two_active_markers import MISSING, SHARP, SMOOTH

Array = NDArray[np.float64]

SENSOR: Final = 1
"""Sensor 2, which measures along X: "positioned at 0 degrees"."""
_THESIS, _OURS, _TRUE = "tab:red", "tab:blue", "0.6"


def draw(path: Path) -> None:
    """Draw subsets, a track, and velocities and accelerations along the sensor and along X."""
    figure = Figure(figsize=(13.0, 11.5), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(4, 2)
    for column, scene in enumerate((SHARP, MISSING)):
        _subsets(axes[0, column], scene)
        _track(axes[1, column], scene)
    _along(axes[2, 0], 0)
    _along(axes[2, 1], 1)
    _in_space(axes[3, 0], 0)
    _in_space(axes[3, 1], 1)
    for axis in axes[-1]:
        axis.set_xlabel("frame")
    figure.savefig(path, dpi=110)


def _subsets(axis: Axes, scene: ActiveScene) -> None:
    subsets = track_pair(scene, SENSOR).subsets_px
    for one, (mark, colour) in enumerate((("*", "tab:green"), ("x", "tab:red"))):
        axis.plot(
            np.arange(scene.frames),
            subsets[:, one],
            mark,
            color=colour,
            ms=3,
            label=f"Subset {one + 1}",
        )
    axis.set(title=f"Figure 6.3, sensor {SENSOR + 1}: {scene.name}", ylabel="position [px]")
    axis.legend(fontsize="small", loc="upper right")


def _track(axis: Axes, scene: ActiveScene) -> None:
    followed = track_pair(scene, SENSOR)
    truth = record(scene).truth.position_px[:, followed.markers[1], SENSOR]
    ours = _ours(scene).position_px[:, followed.markers[1], SENSOR]
    axis.plot(truth, color=_TRUE, lw=4, label="Target 2")
    axis.plot(
        np.arange(scene.frames), followed.position_px[:, 1], color=_THESIS, lw=1, label="thesis"
    )
    axis.plot(ours, "--", color=_OURS, lw=1, label="ours")
    axis.set(title=f"Figure 6.5: the track of Target 2, {scene.name}", ylabel="position [px]")
    axis.legend(fontsize="small", loc="upper right")


def _along(axis: Axes, order: int) -> None:
    followed = track_pair(SHARP, SENSOR)
    target = followed.markers[1]
    thesis = differences(followed.position_px[:, 1], np.full(SHARP.frames - 1, 1.0 / RATE_HZ))[
        order
    ]
    ours, truth = _ours(SHARP), record(SHARP).truth
    name = ("velocity_px_s", "acceleration_px_s2")[order]
    axis.plot(thesis, color=_THESIS, lw=0.8, label="thesis")
    axis.plot(
        np.arange(SHARP.frames),
        getattr(ours, name)[:, target, SENSOR],
        color=_OURS,
        lw=1.2,
        label="ours",
    )
    axis.plot(
        np.arange(SHARP.frames), getattr(truth, name)[:, target, SENSOR], "k:", lw=0.8, label="true"
    )
    axis.set(
        title=f"Figure 6.6: {('velocity', 'acceleration')[order]} of Target 2 along the sensor, "
        f"{SHARP.name}",
        ylabel=("px/s", "px/s$^2$")[order],
    )
    axis.legend(fontsize="small", loc="upper right")


def _in_space(axis: Axes, order: int) -> None:
    name = ("velocity_mm_s", "acceleration_mm_s2")[order]
    for found, colour, label in (
        (by_differences(SHARP), _THESIS, "thesis, from tracked readings"),
        (our_kinematics(SHARP, SMOOTH), _OURS, "ours"),
    ):
        axis.plot(
            np.arange(SHARP.frames), getattr(found, name)[:, 0, 0], color=colour, lw=1, label=label
        )
    truth = getattr(true_kinematics(SHARP), name)[:, 0, 0]
    axis.plot(truth, "k:", lw=0.8, label="true")
    reach = 2.5 * float(np.abs(truth).max())
    axis.set(
        title=f"Figure 6.17: {('velocity', 'acceleration')[order]} of Target 1 along X",
        ylabel=("mm/s", "mm/s$^2$")[order],
        ylim=(-reach, reach),
    )
    axis.legend(fontsize="small", loc="upper right")


def _ours(scene: ActiveScene) -> Readings:
    found = our_kinematics(scene)
    motion = Motion(
        record(scene).motion.time_s,
        found.position_mm,
        found.velocity_mm_s,
        found.acceleration_mm_s2,
    )
    return readings(motion, cameras())
