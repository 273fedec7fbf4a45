"""What the kernel reads of FitSettings and a LineShape, packed into one buffer."""

from math import exp, log, sqrt
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.signal.fit.settings import NARROW_POWER, WIDTH_LIMITS_PX, FitSettings
from compute.signal.fit.shape import LineShape

_PLAN: Final = np.dtype(
    [
        *[
            (name, "<f8")
            for name in (
                "width_px",
                "log_width",
                "prior",
                "reach",
                "shape_error2",
                "least_start",
                "most_start",
                "least_log",
                "most_log",
                "width_unit",
                "margin",
                "first",
                "inverse_step",
                "first_node",
                "node_step",
                "narrow4",
            )
        ],
        *[
            (name, "<i4")
            for name in (
                "max_joint",
                "sloped",
                "width_is_fitted",
                "has_prior",
                "sensors",
                "nodes",
                "pieces",
                "limits",
                "further_peaks",
            )
        ],
    ],
    align=True,
)
"""The kernel's ``Plan``."""


def pack_plan(settings: FitSettings, shape: LineShape) -> NDArray[np.uint64]:
    """Pack a plan, the limits of chi-square, and the shape's pieces in float64 and in float32.

    A piece is the cubic in the part of the way from one place to the next: four coefficients.
    One before the first and one behind the last are constant.

    Returns:
        64-bit words, to keep them aligned.
    """
    spread = settings.width_spread
    low, high = WIDTH_LIMITS_PX
    factor = exp(min(2.0 * spread, 700.0))
    limits = settings.misfit_limits()
    sensors, nodes, places = shape.edge.shape
    # The pieces in float32 are read 16 bytes at a time.
    limits = np.append(limits, np.full((_PLAN.itemsize // 8 + len(limits)) % 2, np.inf))
    plan = np.zeros((), _PLAN)
    plan["width_px"] = settings.width_px
    plan["log_width"] = log(settings.width_px)
    plan["prior"] = spread**-2 if 0.0 < spread < np.inf else 0.0
    plan["narrow4"] = settings.narrow_px**NARROW_POWER
    plan["reach"] = settings.reach
    plan["shape_error2"] = settings.shape_error**2
    plan["least_start"] = min(max(settings.width_px / factor, low), high)
    plan["most_start"] = min(max(settings.width_px * factor, low), high)
    plan["least_log"], plan["most_log"] = log(low), log(high)
    plan["width_unit"] = 2.0 * sqrt(-2.0 * log(settings.search.threshold_fraction))
    plan["margin"] = settings.split_margin
    plan["first"], plan["inverse_step"] = shape.first - shape.step, 1.0 / shape.step
    plan["first_node"], plan["node_step"] = shape.first_node_px, shape.node_step_px
    plan["max_joint"] = settings.max_joint
    plan["sloped"] = settings.background == "slope"
    plan["width_is_fitted"] = spread > 0.0
    plan["has_prior"] = 0.0 < spread < np.inf
    plan["sensors"], plan["nodes"], plan["pieces"] = sensors, nodes, places + 1
    plan["limits"] = len(limits)
    plan["further_peaks"] = settings.further_peaks
    pieces = _pieces(shape)
    parts = [plan.reshape(1), limits, pieces, pieces.astype(np.float32)]
    return np.frombuffer(b"".join(part.tobytes() for part in parts), np.uint64).copy()


def _pieces(shape: LineShape) -> NDArray[np.float64]:
    """Return coefficients of the shape's cubics, shape (S, N, T + 1, 4)."""
    edge, slope = shape.edge, shape.slope * shape.step
    rise = np.diff(edge, axis=2)
    before, after = slope[..., :-1], slope[..., 1:]
    pieces = np.zeros((*edge.shape[:2], edge.shape[2] + 1, 4))
    pieces[:, :, 0, 0] = edge[..., 0]
    pieces[:, :, 1:, 0] = edge
    pieces[:, :, 1:-1, 1] = before
    pieces[:, :, 1:-1, 2] = 3.0 * rise - 2.0 * before - after
    pieces[:, :, 1:-1, 3] = before + after - 2.0 * rise
    return pieces
