"""Plot of the demo: the bar's trajectory and the residuals."""

from pathlib import Path

import matplotlib as mpl
import numpy as np
from numpy.typing import NDArray

mpl.use("Agg")

from matplotlib import pyplot as plt

Array = NDArray[np.float64]


def circle_of(points: Array) -> tuple[Array, float, Array, Array]:
    """Fit a circle in space to points (N, 3) [mm].

    Returns:
        Centre (3,), radius, distances from the circle along the radius (N,) and along the
        normal of its plane (N,).
    """
    centre = points.mean(axis=0)
    _, _, axes = np.linalg.svd(points - centre, full_matrices=False)
    flat = (points - centre) @ axes[:2].T
    # |x - c|^2 = r^2 is linear in c and r^2 - |c|^2.
    design = np.column_stack([2.0 * flat, np.ones(len(flat))])
    solution = np.linalg.lstsq(design, (flat**2).sum(axis=1), rcond=None)[0]
    radius = float(np.sqrt(solution[2] + solution[:2] @ solution[:2]))
    radial = np.linalg.norm(flat - solution[:2], axis=1) - radius
    return centre + solution[:2] @ axes[:2], radius, radial, (points - centre) @ axes[2]


def save_picture(
    path: Path, time_s: Array, ends: tuple[Array, Array], length_mm: float, latency_ms: Array
) -> None:
    """Draw trajectory, bar length, distances from the circle, and latency.

    Args:
        path: PNG to write.
        time_s: times (N,).
        ends: positions of the two markers (N, 3) [mm].
        length_mm: the bar's true length.
        latency_ms: latencies of all frames.
    """
    figure, axes = plt.subplots(2, 2, figsize=(11, 8.5), constrained_layout=True)
    figure.suptitle(
        "Lumiline demo: rotating bar, 4 linear sensors of 2048 pixels, 1 kHz", fontsize=13
    )
    trajectory, length, circle, latency = axes.ravel()
    for index, (points, colour) in enumerate(zip(ends, ("tab:blue", "tab:orange"), strict=True)):
        trajectory.plot(
            points[:, 0], points[:, 2], ".", ms=2, color=colour, label=f"marker {index}"
        )
    every = max(1, len(time_s) // 24)
    for first, second in zip(ends[0][::every], ends[1][::every], strict=True):
        trajectory.plot([first[0], second[0]], [first[2], second[2]], "-", color="0.85", zorder=0)
    trajectory.set(xlabel="X [mm]", ylabel="Z, depth [mm]", title="Trajectory from above")
    trajectory.set_aspect("equal", "datalim")
    trajectory.legend(loc="upper right")

    error = np.linalg.norm(ends[0] - ends[1], axis=1) - length_mm
    length.plot(time_s, error * 1000.0, ".", ms=2, color="tab:green")
    length.axhline(0.0, color="0.5", lw=1)
    length.set(
        xlabel="time [s]",
        ylabel="length - true length [um]",
        title=f"Bar length: {error.mean() * 1000:+.1f} um, standard deviation "
        f"{error.std(ddof=1) * 1000:.1f} um",
    )

    _, _, radial, axial = circle_of(ends[0])
    circle.plot(time_s, radial * 1000.0, ".", ms=2, label="along the radius")
    circle.plot(time_s, axial * 1000.0, ".", ms=2, label="across the plane")
    circle.set(
        xlabel="time [s]", ylabel="distance [um]", title="Marker 0: distance from its circle"
    )
    circle.legend(loc="upper right")

    latency.hist(latency_ms, bins=np.geomspace(latency_ms.min(), latency_ms.max() + 1e-6, 60))
    latency.set(
        xscale="log",
        yscale="log",
        xlabel="exposure to client [ms]",
        ylabel="frames",
        title=f"Latency: median {np.median(latency_ms):.2f} ms",
    )
    figure.savefig(path, dpi=110)
    plt.close(figure)
