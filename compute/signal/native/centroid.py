"""Native source of the whole kernel: threshold and centre of gravity."""

from typing import Final

from compute.signal.native.cpu_line import CPU_LINE
from compute.signal.native.cuda_sizes import CANDIDATE_LINES_PER_BATCH, LINES_PER_BATCH
from compute.signal.native.cuda_warp import CUDA_WARP
from compute.signal.native.measure import MEASURE, RUN
from compute.signal.native.prelude import CONSTANTS, LEVEL, TYPES


def find_peaks_source(lines_per_batch: int) -> str:
    """Return the source with so many lines for a warp to take together, at most 4."""
    return (
        CONSTANTS
        + TYPES
        + LEVEL
        + RUN
        + MEASURE
        + "#if defined(__CUDA_ARCH__)\n"
        + f"    const int batch_lines = {lines_per_batch};\n"
        + CUDA_WARP
        + "#else\n"
        + CPU_LINE
        + "#endif\n"
    )


FIND_PEAKS: Final = find_peaks_source(CANDIDATE_LINES_PER_BATCH)
"""The search that a fit begins with."""
FIND_CENTROIDS: Final = find_peaks_source(LINES_PER_BATCH)
