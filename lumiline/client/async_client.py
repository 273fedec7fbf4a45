"""AsyncClient: a server's resources and streams, with asyncio."""

from collections.abc import Sequence

from lumiline.client.async_stream import AsyncStream
from lumiline.client.beam_holds.async_methods import AsyncBeamHoldMethods
from lumiline.client.devices.async_methods import AsyncDeviceMethods
from lumiline.client.recordings.async_methods import AsyncRecordingMethods
from lumiline.client.registrations.async_methods import AsyncRegistrationMethods
from lumiline.client.stream_state import Content, Mode, StreamRequest, start_state
from lumiline.client.tools.async_methods import AsyncToolMethods


class AsyncClient(
    AsyncDeviceMethods,
    AsyncToolMethods,
    AsyncRegistrationMethods,
    AsyncBeamHoldMethods,
    AsyncRecordingMethods,
):
    """A connection to a server, with asyncio; a context manager that closes it.

    ``ServerProblem`` is raised where the server refuses, with its reason, ``ServerUnreachable`` where it
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
        request = StreamRequest(device_id, tuple(content), mode, rate_hz, bundle_ms)
        return AsyncStream(start_state(self._server, request, resume, reconnect_s), self._timeout_s)
