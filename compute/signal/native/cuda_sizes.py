"""Sizes of the CUDA kernels: threads of a block, lines and pixels that a warp takes together."""

from typing import Final

BLOCK_THREADS: Final = 64
BLOCK_PIXELS: Final = 2048
LINES_PER_BATCH: Final = 4
"""Lines of a block that a warp takes together, at most 4. With eight peaks each, every lane has
one. Of longer lines it takes fewer, down to one of as many blocks."""
SHORT_PIXELS: Final = LINES_PER_BATCH * BLOCK_PIXELS
"""Lines up to this length are brought to shared memory whole."""
LAUNCH_BOUNDS: Final = (BLOCK_THREADS, 6)
"""As many blocks of so many lines as shared memory has room for."""
CANDIDATE_LINES_PER_BATCH: Final = 3
"""The same where a fit follows: for its arithmetic, more warps are worth more."""
