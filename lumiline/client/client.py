"""Client: a server's resources and streams, for programs that wait."""

from collections.abc import Sequence

from lumiline.client.beam_holds.methods import BeamHoldMethods
from lumiline.client.devices.methods import DeviceMethods
from lumiline.client.recordings.methods import RecordingMethods
from lumiline.client.registrations.methods import RegistrationMethods
from lumiline.client.stream import Stream
from lumiline.client.stream_state import Content, Mode, StreamRequest, start_state
from lumiline.client.tools.methods import ToolMethods


class Client(
    DeviceMethods,
    ToolMethods,
    RegistrationMethods,
    BeamHoldMethods,
    RecordingMethods,
):
    """A connection to a server; a context manager that closes it.

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
    ) -> Stream:
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
        return Stream(start_state(self._server, request, resume, reconnect_s), self._timeout_s)
