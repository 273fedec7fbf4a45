"""Definitions of the fit for C++ and Python: constants, records of peaks, settings as a buffer."""

from math import exp, log, sqrt
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.native.records import Record, constants, header
from compute.signal.fit.fit_settings import (
    CONVERGENCE_THRESHOLD_SIGMA,
    LOG_WIDTH_SIGMA_THRESHOLD,
    MAX_ITERATIONS,
    MAX_LOG_LIKELIHOOD_RISE,
    MAX_WIDTH_NODES,
    MAX_WINDOW_PX,
    MIN_LOG_WEIGHT,
    MIN_PIVOT,
    MIN_SURROUNDING_PIXELS,
    NARROW_POWER,
    SPLIT_LOG_WIDTH,
    SPLIT_WIDTHS,
    STEP_LOG_WIDTH,
    STEP_WIDTHS,
    SURROUNDING_LIMIT_SIGMA,
    SURROUNDING_PIXELS,
    WIDTH_LIMITS_PX,
    FitSettings,
)
from compute.signal.fit.line_spread_function import LineSpreadFunction
from compute.signal.native.definitions import PEAK_FIELDS, scan_record
from compute.signal.peaks import MAX_JOINT_PEAKS, PeakFlag

FITTED_PEAK: Final = Record(
    "FittedPeak",
    {
        **PEAK_FIELDS,
        "reduced_chi2": "float",
        "covariance_px2": f"float[{MAX_JOINT_PEAKS - 1}]",
    },
)

PLAN: Final = Record(
    "Plan",
    dict.fromkeys(
        (
            "width_px", "log_width", "prior", "reach", "shape_error2", "min_start", "max_start",
            "min_log", "max_log", "width_unit", "margin", "first", "inverse_step", "first_node",
            "node_step", "narrow4",
        ),
        "double",
    )
    | dict.fromkeys(
        (
            "max_joint_peaks", "sloped", "width_is_fitted", "has_prior", "sensors", "nodes",
            "pieces", "limits", "further_peaks", "surrounded",
        ),
        "int",
    ),
)  # fmt: skip
"""What of the settings and the line shape the kernel reads."""

HEADER: Final = header(
    "lumiline::signal",
    FITTED_PEAK.source,
    PLAN.source,
    constants(
        {
            "joint_peaks": MAX_JOINT_PEAKS,
            "max_window": MAX_WINDOW_PX,
            "max_iterations": MAX_ITERATIONS,
            "converged2": CONVERGENCE_THRESHOLD_SIGMA**2,
            "step_widths": STEP_WIDTHS,
            "step_log_width": STEP_LOG_WIDTH,
            "split_widths": SPLIT_WIDTHS,
            "split_log_width": SPLIT_LOG_WIDTH,
            "min_pivot": MIN_PIVOT,
            "min_closed_information": LOG_WIDTH_SIGMA_THRESHOLD**-2,
            "narrow_power": float(NARROW_POWER),
            "open_width2": LOG_WIDTH_SIGMA_THRESHOLD**2,
            "max_nodes": MAX_WIDTH_NODES,
            "max_log_likelihood_rise": MAX_LOG_LIKELIHOOD_RISE,
            "min_log_weight": MIN_LOG_WEIGHT,
            "surrounding_pixels": SURROUNDING_PIXELS,
            "min_surrounding_pixels": MIN_SURROUNDING_PIXELS,
            "surrounding_limit2": SURROUNDING_LIMIT_SIGMA**2,
            "flag_masked": PeakFlag.MASKED_PIXELS,
            "flag_joint": PeakFlag.JOINT,
            "flag_poor_fit": PeakFlag.POOR_FIT,
            "flag_unfitted": PeakFlag.UNFITTED,
        }
    ),
    includes=("compute/signal/native/definitions.gen.h",),
)


def fitted_scan_record(max_peaks: int) -> np.dtype[np.void]:
    """Return the type of one scan's record: fitted peaks, then the candidates of the search."""
    return np.dtype(
        [
            ("count", "<i4"),
            ("truncated", "<i4"),
            ("peaks", FITTED_PEAK.dtype, (max_peaks,)),
            ("candidates", scan_record(max_peaks)),
        ]
    )


def pack_plan(settings: FitSettings, shape: LineSpreadFunction) -> NDArray[np.uint64]:
    """Pack settings, chi-square limits, and the cubic pieces of the shape in float64 and float32.

    A piece is the cubic in the part of the way from one place to the next: four coefficients.
    One before the first and one behind the last are constant.

    Args:
        settings: of the fit.
        shape: the line-spread function.

    Returns:
        64-bit words, to keep them aligned.
    """
    sigma = settings.width_log_sigma
    low, high = WIDTH_LIMITS_PX
    factor = exp(min(2.0 * sigma, 700.0))
    # The chi-square whose excess widens lies behind that of a false split.
    limits = np.concatenate([settings.chi2_limits(), settings.noise_chi2()])
    sensors, nodes, cells = shape.cumulative.shape
    # The pieces in float32 are read 16 bytes at a time.
    limits = np.append(limits, np.full((PLAN.dtype.itemsize // 8 + len(limits)) % 2, np.inf))
    plan = np.zeros((), PLAN.dtype)
    plan["width_px"] = settings.width_px
    plan["log_width"] = log(settings.width_px)
    plan["prior"] = sigma**-2 if 0.0 < sigma < np.inf else 0.0
    plan["narrow4"] = settings.narrow_width_px**NARROW_POWER
    plan["reach"] = settings.reach
    plan["shape_error2"] = settings.shape_error**2
    plan["min_start"] = min(max(settings.width_px / factor, low), high)
    plan["max_start"] = min(max(settings.width_px * factor, low), high)
    plan["min_log"], plan["max_log"] = log(low), log(high)
    plan["width_unit"] = 2.0 * sqrt(-2.0 * log(settings.search.threshold_fraction))
    plan["margin"] = settings.split_margin
    plan["first"], plan["inverse_step"] = shape.first - shape.step, 1.0 / shape.step
    plan["first_node"], plan["node_step"] = shape.first_node_px, shape.node_step_px
    plan["max_joint_peaks"] = settings.max_joint_peaks
    plan["sloped"] = settings.background == "slope"
    plan["surrounded"] = settings.background == "surrounding-slope"
    plan["width_is_fitted"] = sigma > 0.0
    plan["has_prior"] = 0.0 < sigma < np.inf
    plan["sensors"], plan["nodes"], plan["pieces"] = sensors, nodes, cells + 1
    plan["limits"] = len(limits)
    plan["further_peaks"] = settings.further_peaks
    pieces = _pieces(shape)
    parts = [plan.reshape(1), limits, pieces, pieces.astype(np.float32)]
    return np.frombuffer(b"".join(part.tobytes() for part in parts), np.uint64).copy()


def _pieces(shape: LineSpreadFunction) -> NDArray[np.float64]:
    """Return coefficients of the shape's cubics, shape (S, N, T + 1, 4)."""
    cumulative, slope = shape.cumulative, shape.density * shape.step
    rise = np.diff(cumulative, axis=2)
    before, after = slope[..., :-1], slope[..., 1:]
    pieces = np.zeros((*cumulative.shape[:2], cumulative.shape[2] + 1, 4))
    pieces[:, :, 0, 0] = cumulative[..., 0]
    pieces[:, :, 1:, 0] = cumulative
    pieces[:, :, 1:-1, 1] = before
    pieces[:, :, 1:-1, 2] = 3.0 * rise - 2.0 * before - after
    pieces[:, :, 1:-1, 3] = before + after - 2.0 * rise
    return pieces
