"""Client and AsyncClient: requests to a server by HTTP, and its streams."""

import asyncio
import json
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path
from typing import IO, Any, Final, Generic, TypeVar
from uuid import uuid4

import httpx

from lumiline.client.errors import ServerUnreachable, UnreadableMessage, server_problem
from lumiline.client.exchange import Asynchronous, Blocking, ClientMethod, path_of, plain, result_of
from lumiline.client.models import Run
from lumiline.client.operations import Operations
from lumiline.client.server import KeyBy, Server
from lumiline.client.stream import AsyncStream, Stream
from lumiline.client.stream_state import Content, Mode, StreamRequest, StreamState

Http = TypeVar("Http", httpx.Client, httpx.AsyncClient)
AnyStream = TypeVar("AnyStream", Stream, AsyncStream)


class _SharedClient(Operations, Generic[Http, AnyStream]):
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
        self._etags = _ETags()
        self._http: Http = self._http_type(
            base_url=self._server.url, headers=self._server.headers, timeout=timeout_s
        )

    def __repr__(self) -> str:
        """Return its address, and whether it has a key, which has no place in a log."""
        server = self._server
        return f"{type(self).__name__}({server.url!r}, key={'***' if server.key else None})"

    @ClientMethod
    async def request(
        self,
        method: str,
        path: str,
        *,
        params: Mapping[str, Any] | None = None,
        body: Any = None,
        timeout_s: float | None = None,
    ) -> Any:
        """Send any request to the server, and return the JSON that it answers.

        Args:
            method: of HTTP.
            path: from the server's root, such as ``/api/v1/devices``.
            params: of the query; those that are None are left out.
            body: sent as JSON; None: nothing.
            timeout_s: how long the answer is waited for [s]; None: as the client says.

        Raises:
            ResourceChanged: it was changed after this client read it (PATCH and PUT).
            ServerProblem: the server refused otherwise.
            ServerUnreachable: it did not answer.
            UnreadableMessage: what it answered is no JSON.
        """
        return await self._request(method, path, params=params, body=body, timeout_s=timeout_s)

    @ClientMethod
    async def wait_for_run(
        self, run_id: str, timeout_s: float = 600.0, every_s: float = 0.2
    ) -> Run:
        """Wait until a run has ended.

        Args:
            run_id: the run.
            timeout_s: longest time to wait [s]; the run is returned as it is then.
            every_s: time between two requests [s].
        """
        end_s = time.monotonic() + timeout_s
        while True:
            found: Run = await self._send(Run, "GET", path_of("/api/v1/runs/{}", run_id))
            if found.state not in ("queued", "running") or time.monotonic() >= end_s:
                return found
            await result_of(self._sleep(every_s))

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
        params: Mapping[str, Any] | None = None,
        headers: Mapping[str, Any] | None = None,
        body: Any = None,
        upload: Path | str | None = None,
        timeout_s: float | None = None,
        extra_timeout_s: float = 0.0,
        text: bool = False,
    ) -> Any:
        what = f"{method} {path}"
        if method in ("PATCH", "PUT") and (headers or {}).get("If-Match") is None:
            headers = {**(headers or {}), "If-Match": await self._etag(path)}
        timeout_s = (self._timeout_s if timeout_s is None else timeout_s) + extra_timeout_s
        repeatable = "Idempotency-Key" in (headers or {})
        if repeatable:
            key = (headers or {})["Idempotency-Key"] or uuid4().hex
            headers = {**(headers or {}), "Idempotency-Key": key}
        request = self._build(
            method, path, params, headers, body, upload, timeout_s + _stated_s(body)
        )
        with self._connection_errors(what):
            try:
                response = await result_of(self._http.send(request))
            except _LOST as lost:
                if not repeatable:
                    raise
                response = await self._send_again(request, lost, timeout_s)
        self._etags.note(path, response.status_code, response.headers.get("ETag"))
        _check(response, response.content)
        if text:
            return response.text
        if not response.content:
            return None
        try:
            return response.json()
        except ValueError as error:
            raise UnreadableMessage(f"{what} did not answer JSON") from error

    async def _send_again(
        self, request: httpx.Request, lost: httpx.TransportError, timeout_s: float
    ) -> httpx.Response:
        """Send a request again whose answer was lost: by its key it is carried out only once."""
        end_s = time.monotonic() + timeout_s
        while time.monotonic() < end_s:
            await result_of(self._sleep(_PAUSE_S))
            response: httpx.Response = await result_of(self._http.send(request))
            if response.status_code != 409 or (
                server_problem(409, response.content).code != "request-in-progress"
            ):
                return response
        raise lost

    async def _etag(self, path: str) -> str:
        """Return the ETag of a resource as this client read it last, or as it is now."""
        if path not in self._etags:
            await self._request("GET", path)
        return self._etags.get(path, "*")

    async def _download(
        self,
        method: str,
        file: Path | str,
        path: str,
        *,
        params: Mapping[str, Any] | None = None,
        body: Any = None,
    ) -> Path:
        file = Path(file)
        request = self._build(method, path, params, None, body, None, self._timeout_s)
        with self._connection_errors(f"{method} {path}"):
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

    def _build(
        self,
        method: str,
        path: str,
        params: Mapping[str, Any] | None,
        headers: Mapping[str, Any] | None,
        body: Any,
        upload: Path | str | None,
        timeout_s: float,
    ) -> httpx.Request:
        """Return a request; members of its query and its header that are None are left out."""
        known = {name: _parameter(value) for name, value in (params or {}).items()}
        content: bytes | None = None
        sent = {name: str(value) for name, value in (headers or {}).items() if value is not None}
        if upload is not None:
            content = Path(upload).read_bytes()
            sent["Content-Type"] = "application/x-hdf5"
        elif body is not None:
            content = json.dumps(body, default=plain, allow_nan=False).encode()
            sent["Content-Type"] = "application/json"
        return self._http.build_request(
            method,
            path,
            params={name: value for name, value in known.items() if value is not None} or None,
            headers=sent,
            content=content,
            timeout=timeout_s,
        )

    @contextmanager
    def _connection_errors(self, what: str) -> Iterator[None]:
        """Raise ServerUnreachable where the connection fails or is lost."""
        try:
            yield
        except httpx.TransportError as error:
            raise ServerUnreachable(
                f"{self._server.url} did not answer {what}: {error or type(error).__name__}"
            ) from error


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


class _ETags(dict[str, str]):
    """ETags of resources by their paths, as they were read; the oldest make room."""

    def note(self, path: str, status: int, etag: str | None) -> None:
        """Keep the ETag of an answer; that of a resource which others changed stays, until read."""
        if status >= 400:
            return
        self.pop(path, None)
        if etag is not None:
            self[path] = etag
            while len(self) > _MAX_ETAGS:
                del self[next(iter(self))]


_MAX_ETAGS: Final = 1000
_LOST: Final = (httpx.ReadError, httpx.WriteError, httpx.RemoteProtocolError)
"""Errors after which nobody knows whether the server has carried a request out."""
_PAUSE_S: Final = 0.5


def _check(response: httpx.Response, body: bytes) -> None:
    """Raise ServerProblem where the server refused."""
    if not response.is_success:
        retry_after = response.headers.get("Retry-After")
        raise server_problem(response.status_code, body, retry_after)


def _parameter(value: Any) -> Any:
    """Return a value as a query has it."""
    return value.isoformat() if isinstance(value, datetime) else value


def _stated_s(body: Any) -> float:
    """Return how long a request says that the server measures or waits [s]."""
    if not isinstance(body, Mapping):
        return 0.0
    stated = [body.get(name) for name in ("duration_s", "timeout_s")]
    return sum(float(value) for value in stated if isinstance(value, int | float))


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
