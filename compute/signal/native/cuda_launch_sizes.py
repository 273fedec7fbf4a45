"""Sizes of the CUDA kernels: threads of a block, scans and pixels that a warp takes together."""

from typing import Final

BLOCK_THREADS: Final = 64
BLOCK_PIXELS: Final = 2048
LINES_PER_BATCH: Final = 4
"""Lines of a block that a warp takes together, at most 4. With eight peaks each, every lane has
one. Of longer lines it takes fewer, down to one of as many blocks."""
SHORT_PIXELS: Final = LINES_PER_BATCH * BLOCK_PIXELS
"""Lines up to this length are brought to shared memory whole."""
LAUNCH_BOUNDS: Final = (BLOCK_THREADS, 6)
"""Blocks that fit in shared memory, by their number of scans."""
LONG_LINES_PER_WARP: Final = 2
"""Of longer lines: the second one's blocks come while the first one's peaks are measured."""
CANDIDATE_LINES_PER_BATCH: Final = 2
"""The same where a fit follows: what shared memory leaves is cache, and that holds the fit's
arrays."""
FIT_LINES_PER_WARP: Final = 32
"""Lines that a warp searches, batch after batch, before it fits: so that most lanes have a group,
even of lines with one peak."""
FIT_LAUNCH_BOUNDS: Final = (BLOCK_THREADS, 512 // BLOCK_THREADS)
"""128 registers a thread: the fit of one peak keeps its sums in them."""
