"""Native source of the whole kernel: threshold and centre of gravity."""

from typing import Final

from compute.signal.native.cpu_line import CPU_LINE
from compute.signal.native.cuda_warp import CUDA_WARP
from compute.signal.native.measure import MEASURE, RUN
from compute.signal.native.prelude import CONSTANTS, LEVEL, TYPES

FIND_PEAKS: Final = (
    CONSTANTS
    + TYPES
    + LEVEL
    + RUN
    + MEASURE
    + "#if defined(__CUDA_ARCH__)\n"
    + CUDA_WARP
    + "#else\n"
    + CPU_LINE
    + "#endif\n"
)
