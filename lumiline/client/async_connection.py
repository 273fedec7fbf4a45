"""AsyncConnection: requests to a server, with asyncio."""

from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Self, TypeVar

import httpx

from lumiline.client.api_request import ApiRequest
from lumiline.client.response import check, connection_errors, json_of, whole_file
from lumiline.client.server import KeyBy, Server

T = TypeVar("T")


class AsyncConnection:
    """A connection to a server, with asyncio; what methods of every resource are made from."""

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
        self._http = httpx.AsyncClient(
            base_url=self._server.url, headers=self._server.headers, timeout=timeout_s
        )

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        await self.close()

    async def close(self) -> None:
        """Close the connections; streams have their own."""
        await self._http.aclose()

    async def request(
        self,
        method: str,
        path: str,
        *,
        query: Mapping[str, Any] | None = None,
        body: Any = None,
        timeout_s: float | None = None,
    ) -> Any:
        """Return the JSON that the server answers to any request of its interface.

        Raises:
            ServerProblem: it refused.
            ServerUnreachable: it did not answer.
            UnreadableMessage: what it answered is no JSON.
        """
        with connection_errors(f"{method} {path}"):
            answer = await self._http.request(
                method,
                path,
                params=None if query is None else dict(query),
                json=body,
                timeout=self._timeout_s if timeout_s is None else timeout_s,
            )
        return json_of(answer, f"{method} {path}")

    async def _one(self, call: ApiRequest[T], longer_s: float = 0.0) -> T:
        answer = await self.request(
            call.method,
            call.path,
            query=call.parameters,
            body=call.body,
            timeout_s=self._timeout_s + longer_s,
        )
        return call.read(answer)

    async def _all(self, call: ApiRequest[T]) -> list[T]:
        found: list[T] = []
        while True:
            query = call.page(len(found))
            items, total = call.items(await self.request("GET", call.path, query=query))
            found += items
            if not items or len(found) >= total:
                return found

    async def _download(self, source: str, path: Path | str, what: str) -> Path:
        path = Path(path)
        with connection_errors(what):
            async with self._http.stream("GET", source) as answer:
                if not answer.is_success:
                    check(answer, await answer.aread())
                with whole_file(path) as file:
                    async for piece in answer.aiter_bytes():
                        file.write(piece)
        return path
