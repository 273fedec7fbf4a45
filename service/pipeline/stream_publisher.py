"""StreamPublisher: what the pipeline needs of whoever sends its results to clients."""

from typing import Protocol

from hardware.driver import DeviceDescription
from service.pipeline.beam_hold_state import BeamHoldState
from service.pipeline.frame_batch import FrameBatch


class StreamPublisher(Protocol):
    """Takes batches and changes of state; all methods may be called from any thread.

    None of them waits for a client. ``service.protocols.stream.hub.Hub`` is the one of the service.
    """

    closed: str | None
    """Why all streams have ended; None: they have not."""

    def publish_batch(self, batch: FrameBatch) -> None:
        """Send a batch of frames to the clients of its device."""
        ...

    def publish_status(
        self,
        device_id: str,
        state: str,
        reason: str | None = None,
        link: str | None = None,
        description: DeviceDescription | None = None,
    ) -> None:
        """Tell the clients of a device its state, with the description of one that runs."""
        ...

    def publish_hold(self, device_id: str, now: BeamHoldState) -> None:
        """Tell the clients of a device, who asked for beam holds, of a change of one."""
        ...

    def subscribers(self, device_id: str) -> int:
        """Return the number of clients of a device."""
        ...

    def end(self, device_id: str) -> None:
        """Tell the clients of a device that it was deleted, and end their streams."""
        ...
