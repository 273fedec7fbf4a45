"""Client and AsyncClient: requests to a server by HTTP, and its streams."""

import asyncio
import time
from collections.abc import Mapping, Sequence
from typing import Any, Generic, TypeVar

import httpx

from lumiline.client.beam_holds import BeamHoldMethods
from lumiline.client.devices import DeviceMethods
from lumiline.client.exchange import (
    AsyncRunner,
    BlockingRunner,
    ClientMethod,
    Download,
    Exchange,
    HttpRequest,
    Pause,
)
from lumiline.client.recordings import RecordingMethods
from lumiline.client.registrations import RegistrationMethods
from lumiline.client.response import check, connection_errors, json_of, whole_file
from lumiline.client.server import KeyBy, Server
from lumiline.client.stream import AsyncStream, Stream
from lumiline.client.stream_state import Content, Mode, StreamRequest, StreamState
from lumiline.client.tools import ToolMethods

Http = TypeVar("Http", httpx.Client, httpx.AsyncClient)
AnyStream = TypeVar("AnyStream", Stream, AsyncStream)


class _SharedClient(
    DeviceMethods,
    ToolMethods,
    RegistrationMethods,
    BeamHoldMethods,
    RecordingMethods,
    Generic[Http, AnyStream],
):
    """What both clients have in common: all but input and output."""

    _http_type: type[Http]
    _stream_type: type[AnyStream]

    def __init__(
        self,
        url: str = "http://127.0.0.1:8000",
        key: str | None = None,
        *,
        key_by: KeyBy = "header",
        timeout_s: float = 30.0,
    ) -> None:
        """Make a client; nothing is sent yet.

        Args:
            url: of the server.
            key: an API key, or a token; None: none is needed.
            key_by: how a stream carries the key: ``header``, or ``subprotocol`` as browsers do.
            timeout_s: how long an answer is waited for [s]; calibrations from live poses take
                their own time besides.
        """
        self._server = Server(url, key, key_by)
        self._timeout_s = timeout_s
        self._http: Http = self._http_type(
            base_url=self._server.url, headers=self._server.headers, timeout=timeout_s
        )

    @ClientMethod
    def request(
        self,
        method: str,
        path: str,
        *,
        query: Mapping[str, Any] | None = None,
        body: Any = None,
        timeout_s: float | None = None,
    ) -> Exchange[Any]:
        """Send any request of the server's interface, and return the JSON that it answers.

        Raises:
            ServerProblem: the server refused.
            ServerUnreachable: it did not answer.
            UnreadableMessage: what it answered is no JSON.
        """
        return (yield HttpRequest(method, path, query, body, timeout_s))

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
    ) -> AnyStream:
        """Return the stream of a device's measurements; it connects with its first message.

        Args:
            device_id: the device.
            content: what frames hold: ``points``, ``peaks``, ``tracks``, ``tools``,
                ``holds``; ``status``: no frames.
            mode: ``live``: the newest frames; ``lossless``: every message, also over lost
                connections.
            rate_hz: highest rate of frames [Hz]; None: every frame.
            bundle_ms: send the frames of this time [ms] together; None: each by itself.
            resume: with ``lossless``: the stream's id, of ``hello``, and the number of the last
                message that the program has, to go on after it.
            reconnect_s: how long a lost connection is tried again [s].

        Raises:
            ValueError: ``resume`` without ``lossless``.
        """
        request = StreamRequest(device_id, tuple(content), mode, rate_hz, bundle_ms)
        state = StreamState.begin(self._server, request, resume, reconnect_s)
        return self._stream_type(state, self._timeout_s)

    def _http_arguments(self, step: HttpRequest) -> dict[str, Any]:
        timeout_s = self._timeout_s if step.timeout_s is None else step.timeout_s
        query = {name: value for name, value in (step.query or {}).items() if value is not None}
        return {
            "method": step.method,
            "url": step.path,
            "params": query or None,
            "json": step.body,
            "timeout": timeout_s + step.extra_timeout_s,
        }


class Client(_SharedClient[httpx.Client, Stream], BlockingRunner):
    """A connection to a server, with blocking calls; a context manager that closes it.

    ``ServerProblem`` is raised where the server refuses, with its reason, ``ServerUnreachable``
    where it does not answer.
    """

    _http_type = httpx.Client
    _stream_type = Stream

    def close(self) -> None:
        """Close the connections; streams have their own."""
        self._http.close()

    def _perform(self, step: HttpRequest | Download | Pause) -> Any:
        match step:
            case HttpRequest():
                what = f"{step.method} {step.path}"
                with connection_errors(what):
                    response = self._http.request(**self._http_arguments(step))
                return json_of(response, what)
            case Download():
                with (
                    connection_errors(f"GET {step.source}"),
                    self._http.stream("GET", step.source) as response,
                ):
                    if not response.is_success:
                        check(response, response.read())
                    with whole_file(step.path) as file:
                        for piece in response.iter_bytes():
                            file.write(piece)
                return step.path
            case Pause():
                time.sleep(step.seconds)
        return None


class AsyncClient(_SharedClient[httpx.AsyncClient, AsyncStream], AsyncRunner):
    """A connection to a server, with asyncio; an asynchronous context manager that closes it.

    ``ServerProblem`` is raised where the server refuses, with its reason, ``ServerUnreachable``
    where it does not answer.
    """

    _http_type = httpx.AsyncClient
    _stream_type = AsyncStream

    async def close(self) -> None:
        """Close the connections; streams have their own."""
        await self._http.aclose()

    async def _perform(self, step: HttpRequest | Download | Pause) -> Any:
        match step:
            case HttpRequest():
                what = f"{step.method} {step.path}"
                with connection_errors(what):
                    response = await self._http.request(**self._http_arguments(step))
                return json_of(response, what)
            case Download():
                with connection_errors(f"GET {step.source}"):
                    async with self._http.stream("GET", step.source) as response:
                        if not response.is_success:
                            check(response, await response.aread())
                        with whole_file(step.path) as file:
                            async for piece in response.aiter_bytes():
                                file.write(piece)
                return step.path
            case Pause():
                await asyncio.sleep(step.seconds)
        return None
