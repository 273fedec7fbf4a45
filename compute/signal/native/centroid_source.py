"""Native source of the whole kernel: threshold and centre of gravity."""

from typing import Final, Literal

from compute.signal.native.centre_of_gravity_source import MEASURE, RUN
from compute.signal.native.cpu_scan_source import CPU_LINE
from compute.signal.native.cuda_launch_sizes import (
    BLOCK_PIXELS,
    CANDIDATE_LINES_PER_BATCH,
    SHORT_PIXELS,
)
from compute.signal.native.cuda_memory_source import CUDA_MEMORY
from compute.signal.native.cuda_warp_source import CUDA_WARP
from compute.signal.native.peak_record import CONSTANTS, LEVEL, TYPES

Length = Literal["block", "short", "long", "any"]
"""Lines of at most BLOCK_PIXELS, of at most SHORT_PIXELS, longer ones, or all: with less to choose
from, the source for CUDA is shorter, which leaves the compiler more registers."""


def length_of(pixels: int) -> Length:
    """Return the name of a line's length."""
    return "block" if pixels <= BLOCK_PIXELS else "short" if pixels <= SHORT_PIXELS else "long"


def find_peaks_source(lines_per_batch: int, length: Length) -> str:
    """Return the source for CUDA's warps to take so many lines of a length, and for the CPU."""
    sizes = (
        f"    const int batch_lines = {lines_per_batch};\n"
        f"    const bool all_blocks = {int(length == 'block')};\n"
        f"    const bool all_short = {int(length in ('block', 'short'))};\n"
        f"    const bool all_long = {int(length == 'long')};\n"
    )
    on_cuda = "#if defined(__CUDA_ARCH__)\n"
    return (
        f"{CONSTANTS}{TYPES}{on_cuda}{sizes}{CUDA_MEMORY}#endif\n"
        f"{LEVEL}{RUN}{MEASURE}{on_cuda}{CUDA_WARP}#else\n{CPU_LINE}#endif\n"
    )


FIND_PEAKS: Final = find_peaks_source(CANDIDATE_LINES_PER_BATCH, "any")
"""The search that a fit begins with."""
