"""Constants and records of the fit, for C++."""

from typing import Final

from compute.native.records import constants, header
from compute.signal.fit.fit_settings import (
    CONVERGENCE_THRESHOLD_SIGMA,
    LOG_WIDTH_SIGMA_THRESHOLD,
    MAX_ITERATIONS,
    MAX_WIDTH_NODES,
    MAX_WINDOW_PX,
    MIN_LOG_WEIGHT,
    MIN_PIVOT,
    NARROW_POWER,
    SPLIT_LOG_WIDTH,
    SPLIT_WIDTHS,
    STEP_LOG_WIDTH,
    STEP_WIDTHS,
)
from compute.signal.fit.fitted_record import FITTED_PEAK
from compute.signal.fit.kernel_parameters import PLAN
from compute.signal.peaks import MAX_JOINT_PEAKS, PeakFlag

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
            "min_log_weight": MIN_LOG_WEIGHT,
            "flag_joint": PeakFlag.JOINT,
            "flag_poor_fit": PeakFlag.POOR_FIT,
            "flag_unfitted": PeakFlag.UNFITTED,
        }
    ),
    includes=("compute/signal/native/definitions.gen.h",),
)
