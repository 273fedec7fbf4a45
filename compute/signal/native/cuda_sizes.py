"""Sizes of the CUDA kernels: threads of a block, lines and pixels that a warp takes together."""

from typing import Final

LINES_PER_BATCH: Final = 3
BLOCK_THREADS: Final = 64
BLOCK_PIXELS: Final = 2048
"""Pixels of a line that are brought to shared memory together."""
STAGED_PIXELS: Final = LINES_PER_BATCH * BLOCK_PIXELS
LAUNCH_BOUNDS: Final = (BLOCK_THREADS, 8)
