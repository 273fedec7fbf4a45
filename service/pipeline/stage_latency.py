"""StageLatency: how long one frame a second takes, stage by stage."""

import time
from collections.abc import Sequence
from itertools import pairwise
from typing import Final, Literal, get_args

from hardware.line_frame import LineFrame
from service.pipeline.threads import FrameRing

Stage = Literal["reception", "waiting", "computation", "publication"]
"""From the middle of the exposure until the driver has the frame; until its batch is taken; until
points, tracks and poses are there (those of tools go out before); until the other holds, taps and
streams have them."""
STAGES: Final[tuple[Stage, ...]] = get_args(Stage)
INTERVAL_S: Final = 1.0


class StageLatency:
    """Times one frame a second: the others cost a comparison each.

    Called where frames are processed, read by any thread.

    Args:
        ring: where frames come from; it notes when the sampled one came.
    """

    def __init__(self, ring: FrameRing) -> None:
        self._ring = ring
        self.due_s = 0.0
        """When the next frame is to be timed, of the monotonic clock [s]."""
        self._requested_s = -INTERVAL_S
        self._sums_s = (0.0,) * len(STAGES)
        self._count = 0

    def sampled(self, frames: Sequence[LineFrame], now_s: float) -> bool:
        """Whether the sampled frame is among these; to be asked from ``due_s`` on.

        Args:
            frames: those of a batch.
            now_s: monotonic time [s].
        """
        sample = self._ring.sample
        if sample is not None and frames[0].sequence <= sample[0] <= frames[-1].sequence:
            self.due_s = now_s + INTERVAL_S
            return True
        if now_s >= self._requested_s + INTERVAL_S:
            # Also where the one before never came here: it was dropped, or nobody looked.
            self._requested_s = now_s
            self._ring.request_sample()
        return False

    def count(self, frames: Sequence[LineFrame], taken_ns: int, computed_ns: int) -> None:
        """Count the sampled frame of a batch that was just published.

        Args:
            frames: those of the batch.
            taken_ns: when the batch was taken [ns since 1970].
            computed_ns: when its results were there [ns since 1970].
        """
        sample = self._ring.sample
        assert sample is not None
        sequence, received_ns = sample
        self._ring.sample = None
        frame = next((one for one in frames if one.sequence >= sequence), frames[-1])
        moments = (frame.exposure_host_ns, received_ns, taken_ns, computed_ns, time.time_ns())
        # A clock that was set back makes no negative time.
        stages = (max(end - begin, 0) * 1e-9 for begin, end in pairwise(moments))
        self._sums_s = tuple(map(sum, zip(self._sums_s, stages, strict=True)))
        self._count += 1

    def sums(self) -> tuple[int, dict[Stage, float]]:
        """Return how many frames were timed, and how long they took in each stage together [s]."""
        return self._count, dict(zip(STAGES, self._sums_s, strict=True))
