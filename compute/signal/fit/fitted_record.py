"""The records that the fit writes: one line's, with its fitted peaks."""

from typing import Final

import numpy as np

from compute.native.records import Record
from compute.signal.native.peak_record import line_record
from compute.signal.peaks import MAX_JOINT_PEAKS

FITTED_PEAK: Final = Record(
    "FittedPeak",
    {
        "position_px": "double",
        "sigma_px": "float",
        "amplitude": "float",
        "width_px": "float",
        "flags": "int",
        "reduced_chi2": "float",
        "covariance_px2": f"float[{MAX_JOINT_PEAKS - 1}]",
    },
)
FITTED_RECORD: Final = FITTED_PEAK.dtype
"""One fitted peak as the kernel writes it."""


def fitted_line_record(max_peaks: int) -> np.dtype[np.void]:
    """Return the type of one line's record: fitted peaks, then the candidates of the search."""
    return np.dtype(
        [
            ("count", "<i4"),
            ("truncated", "<i4"),
            ("peaks", FITTED_RECORD, (max_peaks,)),
            ("candidates", line_record(max_peaks)),
        ]
    )
