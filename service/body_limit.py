"""ASGI middleware that refuses request bodies above a limit, before they are read."""

from starlette.datastructures import Headers
from starlette.exceptions import HTTPException
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.errors import BodyTooLarge
from service.problem_handlers import problem_response
from service.problems import problem_type_of


class BodyLimit:
    """Answers 413 when the declared or the received length exceeds ``limit_bytes``."""

    def __init__(self, app: ASGIApp, limit_bytes: int) -> None:
        self._app = app
        self._limit_bytes = limit_bytes

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on, counting what it receives."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        declared = Headers(scope=scope).get("content-length", "")
        if declared.isdecimal() and int(declared[:20]) > self._limit_bytes:
            await self._refusal(scope, f"{declared[:20]} bytes")(scope, receive, send)
            return
        received = 0

        async def counted() -> Message:
            nonlocal received
            message = await receive()
            received += len(message.get("body", b""))
            if received > self._limit_bytes:
                # An HTTPException, because FastAPI turns any other one raised here into 400.
                raise HTTPException(413, self._detail(f"more than {self._limit_bytes} bytes"))
            return message

        await self._app(scope, counted, send)

    def _detail(self, size: str) -> str:
        return f"the body has {size}; the limit is {self._limit_bytes} bytes"

    def _refusal(self, scope: Scope, size: str) -> ASGIApp:
        kind = problem_type_of(BodyTooLarge)
        return problem_response(kind, self._detail(size), scope["path"])
