"""Native source of the whole kernel: threshold and centre of gravity."""

from typing import Final, Literal

from compute.signal.native.cpu_line import CPU_LINE
from compute.signal.native.cuda_sizes import CANDIDATE_LINES_PER_BATCH
from compute.signal.native.cuda_warp import CUDA_WARP
from compute.signal.native.measure import MEASURE, RUN
from compute.signal.native.prelude import CONSTANTS, LEVEL, TYPES

Length = Literal["short", "long", "any"]
"""Lines of at most SHORT_PIXELS, longer ones, or both: with one of the two, the source for CUDA is
half as long, which leaves the compiler more registers."""


def find_peaks_source(lines_per_batch: int, length: Length) -> str:
    """Return the source for CUDA's warps to take so many lines of a length, and for the CPU."""
    return (
        CONSTANTS
        + TYPES
        + LEVEL
        + RUN
        + MEASURE
        + "#if defined(__CUDA_ARCH__)\n"
        + f"    const int batch_lines = {lines_per_batch};\n"
        + f"    const bool all_short = {int(length == 'short')};\n"
        + f"    const bool all_long = {int(length == 'long')};\n"
        + CUDA_WARP
        + "#else\n"
        + CPU_LINE
        + "#endif\n"
    )


FIND_PEAKS: Final = find_peaks_source(CANDIDATE_LINES_PER_BATCH, "any")
"""The search that a fit begins with."""
