"""AsyncClient: a server's resources and streams, with asyncio."""

from collections.abc import Sequence

from lumiline.client.async_stream import AsyncStream
from lumiline.client.devices.async_methods import AsyncDeviceMethods
from lumiline.client.holds.async_methods import AsyncHoldMethods
from lumiline.client.recordings.async_methods import AsyncRecordingMethods
from lumiline.client.registrations.async_methods import AsyncRegistrationMethods
from lumiline.client.stream_state import Content, Mode, StreamWish, begun
from lumiline.client.tools.async_methods import AsyncToolMethods


class AsyncClient(
    AsyncDeviceMethods,
    AsyncToolMethods,
    AsyncRegistrationMethods,
    AsyncHoldMethods,
    AsyncRecordingMethods,
):
    """A connection to a server, with asyncio; a context manager that closes it.

    ``ServerProblem`` is raised where the server refuses, with its reason, ``NotReached`` where it
    does not answer.
    """

    def stream(
        self,
        device_id: str,
        content: Sequence[Content] = ("points",),
        *,
        mode: Mode = "live",
        rate_hz: float | None = None,
        bundle_ms: float | None = None,
        resume: tuple[str, int] | None = None,
        reconnect_s: float = 30.0,
    ) -> AsyncStream:
        """Return what a device measures, as it comes.

        Args:
            device_id: the device.
            content: what frames hold: ``points``, ``peaks``, ``tracks``, ``tools``,
                ``holds``; ``status``: no frames.
            mode: ``live``: what is new; ``lossless``: every message, also over lost connections.
            rate_hz: at most so many frames a second.
            bundle_ms: frames of so many ms sent together.
            resume: with ``lossless``: the stream's id, of ``hello``, and the number of the last
                message that the program has, to go on after it.
            reconnect_s: how long a lost connection is tried again [s].
        """
        wish = StreamWish(device_id, tuple(content), mode, rate_hz, bundle_ms)
        return AsyncStream(begun(self._server, wish, resume, reconnect_s), self._timeout_s)
