"""Client and AsyncClient: requests to a server by HTTP, and its streams."""

import asyncio
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any, Generic, TypeVar

import httpx

from lumiline.client.beam_holds import BeamHoldMethods
from lumiline.client.devices import DeviceMethods
from lumiline.client.errors import ServerUnreachable, UnreadableMessage, server_problem
from lumiline.client.exchange import Asynchronous, Blocking, ClientMethod, path_of, result_of
from lumiline.client.radiometric import RadiometricMethods
from lumiline.client.recordings import RecordingMethods
from lumiline.client.registrations import RegistrationMethods
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
    RadiometricMethods,
    Generic[Http, AnyStream],
):
    """Settings, requests and streams of a client; its subclasses add input and output."""

    _http_type: type[Http]
    _stream_type: type[AnyStream]
    _pieces: Callable[[httpx.Response], AsyncIterator[bytes]]
    _end: Callable[[httpx.Response], Awaitable[None]]

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
    async def request(
        self,
        method: str,
        path: str,
        *,
        query: Mapping[str, Any] | None = None,
        body: Any = None,
        timeout_s: float | None = None,
    ) -> Any:
        """Send any request of the server's interface, and return the JSON that it answers.

        Raises:
            ServerProblem: the server refused.
            ServerUnreachable: it did not answer.
            UnreadableMessage: what it answered is no JSON.
        """
        return await self._request(method, path, query=query, body=body, timeout_s=timeout_s)

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
            bundle_ms: send the frames of this time [ms] together, which costs both sides far less
                at thousands of frames a second; None: each by itself.
            resume: with ``lossless``: the stream's id, of ``hello``, and the number of the last
                message that the program has, to go on after it.
            reconnect_s: how long a lost connection is tried again [s].

        Raises:
            ValueError: ``resume`` without ``lossless``.
        """
        request = StreamRequest(device_id, tuple(content), mode, rate_hz, bundle_ms)
        state = StreamState.begin(self._server, request, resume, reconnect_s)
        return self._stream_type(state, self._timeout_s)

    async def _request(
        self,
        method: str,
        path: str,
        *,
        query: Mapping[str, Any] | None = None,
        body: Any = None,
        timeout_s: float | None = None,
        extra_timeout_s: float = 0.0,
    ) -> Any:
        what = f"{method} {path}"
        known = {name: value for name, value in (query or {}).items() if value is not None}
        timeout_s = (self._timeout_s if timeout_s is None else timeout_s) + extra_timeout_s
        with _connection_errors(what):
            response = await result_of(
                self._http.request(method, path, params=known or None, json=body, timeout=timeout_s)
            )
        _check(response, response.content)
        if not response.content:
            return None
        try:
            return response.json()
        except ValueError as error:
            raise UnreadableMessage(f"{what} did not answer JSON") from error

    async def _download(self, file: Path | str, *path: str) -> Path:
        source, file = path_of(*path), Path(file)
        with _connection_errors(f"GET {source}"):
            request = self._http.build_request("GET", source)
            response = await result_of(self._http.send(request, stream=True))
            try:
                if not response.is_success:
                    _check(response, b"".join([piece async for piece in self._pieces(response)]))
                with _whole_file(file) as target:
                    async for piece in self._pieces(response):
                        target.write(piece)
            finally:
                await self._end(response)
        return file


class Client(_SharedClient[httpx.Client, Stream], Blocking):
    """A connection to a server, with blocking calls; a context manager that closes it.

    ``ServerProblem`` is raised where the server refuses, with its reason, ``ServerUnreachable``
    where it does not answer.
    """

    _http_type = httpx.Client
    _stream_type = Stream
    _sleep = staticmethod(time.sleep)

    def close(self) -> None:
        """Close the connections; streams have their own."""
        self._http.close()

    @staticmethod
    async def _pieces(response: httpx.Response) -> AsyncIterator[bytes]:
        for piece in response.iter_bytes():
            yield piece

    @staticmethod
    async def _end(response: httpx.Response) -> None:
        response.close()


class AsyncClient(_SharedClient[httpx.AsyncClient, AsyncStream], Asynchronous):
    """A connection to a server, with asyncio; an asynchronous context manager that closes it.

    ``ServerProblem`` is raised where the server refuses, with its reason, ``ServerUnreachable``
    where it does not answer.
    """

    _http_type = httpx.AsyncClient
    _stream_type = AsyncStream
    _sleep = staticmethod(asyncio.sleep)
    _pieces = staticmethod(httpx.Response.aiter_bytes)
    _end = staticmethod(httpx.Response.aclose)

    async def close(self) -> None:
        """Close the connections; streams have their own."""
        await self._http.aclose()


def _check(response: httpx.Response, body: bytes) -> None:
    """Raise ServerProblem where the server refused."""
    if not response.is_success:
        retry_after = response.headers.get("Retry-After")
        raise server_problem(response.status_code, body, retry_after)


@contextmanager
def _connection_errors(what: str) -> Iterator[None]:
    """Raise ServerUnreachable where the connection fails or is lost."""
    try:
        yield
    except httpx.TransportError as error:
        raise ServerUnreachable(f"{what}: {error or type(error).__name__}") from error


@contextmanager
def _whole_file(path: Path) -> Iterator[IO[bytes]]:
    """Open a temporary file, which takes its name only when all of it is written."""
    part = path.with_name(f"{path.name}.part")
    try:
        with part.open("wb") as file:
            yield file
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)
