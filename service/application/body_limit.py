"""ASGI middleware that refuses request bodies above a limit, and those that do not arrive."""

import time
from collections.abc import Mapping

from anyio import fail_after
from starlette.datastructures import Headers
from starlette.exceptions import HTTPException
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.problems.catalogue import problem_type_of
from service.problems.errors import BodyTooLarge
from service.problems.handlers import problem_response


class BodyLimitMiddleware:
    """Answers 413 when the declared or the received length exceeds the path's limit.

    And 408 when the body is not there within a time: whoever sends it byte by byte would otherwise
    hold a connection for nothing.
    """

    def __init__(
        self,
        app: ASGIApp,
        limit_bytes: int,
        others: Mapping[str, int] | None = None,
        seconds: float = 60.0,
    ) -> None:
        """Limit bodies to ``limit_bytes``, on the paths of ``others`` to what stands there."""
        self._app = app
        self._seconds = seconds
        self._limit_bytes = limit_bytes
        self._others = dict(others or {})

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on, counting what it receives."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        limit = self._others.get(scope["path"], self._limit_bytes)
        declared = Headers(scope=scope).get("content-length", "")
        if declared.isdecimal() and int(declared[:20]) > limit:
            await self._refusal(scope, f"{declared[:20]} bytes", limit)(scope, receive, send)
            return
        received = 0
        whole = False
        until = time.monotonic() + self._seconds

        async def counted() -> Message:
            nonlocal received, whole
            if whole:  # what comes now is the end of the connection, whenever
                return await receive()
            try:
                with fail_after(max(0.0, until - time.monotonic())):
                    message = await receive()
            except TimeoutError:
                raise HTTPException(
                    408,
                    f"the body did not arrive within {self._seconds:g} s; {received} bytes came",
                ) from None
            whole = not message.get("more_body", False)
            received += len(message.get("body", b""))
            if received > limit:
                # An HTTPException, because FastAPI turns any other one raised here into 400.
                raise HTTPException(413, _detail(f"more than {limit} bytes", limit))
            return message

        await self._app(scope, counted, send)

    def _refusal(self, scope: Scope, size: str, limit: int) -> ASGIApp:
        kind = problem_type_of(BodyTooLarge)
        return problem_response(kind, _detail(size, limit), scope["path"])


def _detail(size: str, limit: int) -> str:
    return f"the body has {size}; the limit is {limit} bytes"
