"""Client methods, written once as coroutines: awaited by one client, run at once by the other."""

import inspect
from collections.abc import Callable, Coroutine, Mapping, Sequence
from functools import wraps
from pathlib import Path
from types import MethodType
from typing import Any, Concatenate, Final, Generic, ParamSpec, Self, TypeVar, overload
from urllib.parse import quote

from pydantic import BaseModel, ValidationError

from lumiline.client.errors import UnreadableMessage

P = ParamSpec("P")
T = TypeVar("T")
Model = TypeVar("Model", bound=BaseModel)

API_ROOT: Final = "/api/v1"
PAGE_SIZE: Final = 200
"""Items that a page of a list has at most."""


async def result_of(value: Any) -> Any:
    """Return a result of either transport: the value itself, or what it is awaited for."""
    return await value if inspect.isawaitable(value) else value


def finish(coroutine: Coroutine[Any, Any, T]) -> T:
    """Run a coroutine of the blocking transport, in which nothing is awaited, to its end."""
    try:
        coroutine.send(None)
    except StopIteration as end:
        result: T = end.value
        return result
    raise RuntimeError("the blocking transport has awaited something")


class Exchanges:
    """Requests of the server's interface, by their paths below its root."""

    _sleep: Callable[[float], Any]

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
        """Send a request, and return the JSON that is answered.

        Args:
            method: of HTTP.
            path: from the server's root.
            query: parameters; those that are None are left out.
            body: sent as JSON; None: nothing.
            timeout_s: how long the answer is waited for [s]; None: as the client says.
            extra_timeout_s: how long the server measures or computes besides [s].
        """
        raise NotImplementedError

    async def _download(self, file: Path | str, *path: str) -> Path:
        """Write what is at a path to a file, and return the file's path."""
        raise NotImplementedError

    async def _get(
        self, kind: type[Model], *path: str, inside: str | None = None, **query: Any
    ) -> Model:
        """Get what is at a path; arguments as of ``_send``."""
        return await self._send(kind, "GET", *path, inside=inside, **query)

    async def _get_all(self, kind: type[Model], *path: str, **query: Any) -> list[Model]:
        """Get a list whole, page by page; raises UnreadableMessage."""
        found: list[Model] = []
        while True:
            part = {**query, "limit": PAGE_SIZE, "offset": len(found)}
            page = await self._request("GET", path_of(*path), query=part)
            match page:
                case {"items": list(items), "total": int(total)}:
                    found += [_read(kind, item, path) for item in items]
                case _:
                    raise UnreadableMessage(f"{path_of(*path)} did not answer a list")
            if not items or len(found) >= total:
                return found

    async def _send(
        self,
        kind: type[Model],
        method: str,
        /,
        *path: str,
        body: Mapping[str, Any] | None = None,
        inside: str | None = None,
        extra_timeout_s: float = 0.0,
        **query: Any,
    ) -> Model:
        """Send a request, and return its answer as a model, or a member of it: ``inside``."""
        answer = await self._request(
            method, path_of(*path), query=query, body=body, extra_timeout_s=extra_timeout_s
        )
        return _read(kind, answer, path, inside)

    async def _delete(self, *path: str) -> None:
        """Delete what is at a path."""
        await self._request("DELETE", path_of(*path))


class Blocking:
    """Runs client methods by blocking calls; a context manager that closes what it opened."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *raised: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the connection."""
        raise NotImplementedError


class Asynchronous:
    """Runs client methods with asyncio; an asynchronous context manager."""

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *raised: object) -> None:
        await self.close()

    async def close(self) -> None:
        """Close the connection."""
        raise NotImplementedError


class ClientMethod(Generic[P, T]):
    """A method of both clients: blocking in the one, a coroutine function in the other.

    Args:
        define: the method, as a coroutine function.
    """

    def __init__(self, define: Callable[Concatenate[Any, P], Coroutine[Any, Any, T]]) -> None:
        @wraps(define)
        def blocking(client: Blocking, *args: P.args, **named: P.kwargs) -> T:
            return finish(define(client, *args, **named))

        self._blocking, self._awaitable = blocking, define

    @overload
    def __get__(self, client: None, owner: type[Any]) -> Callable[..., Any]: ...
    @overload
    def __get__(self, client: Blocking, owner: type[Any]) -> Callable[P, T]: ...
    @overload
    def __get__(
        self, client: Asynchronous, owner: type[Any]
    ) -> Callable[P, Coroutine[Any, Any, T]]: ...

    def __get__(
        self, client: Blocking | Asynchronous | None, owner: type[Any]
    ) -> Callable[..., Any]:
        """Return the method, bound to a client where there is one."""
        function = self._awaitable if issubclass(owner, Asynchronous) else self._blocking
        return function if client is None else MethodType(function, client)


def path_of(*parts: str) -> str:
    """Return a path below the interface's root."""
    # Names of recordings have slashes, which are part of their path.
    return "/".join([API_ROOT, *(quote(part) for part in parts)])


def float_rows(points: Sequence[Sequence[float]]) -> list[list[float]]:
    """Return points as lists of floats, for JSON."""
    return [list(map(float, point)) for point in points]


def _read(
    kind: type[Model], answer: Any, path: tuple[str, ...], inside: str | None = None
) -> Model:
    """Return the server's answer, or a member of it, as a model."""
    if inside is not None:
        if not isinstance(answer, dict) or inside not in answer:
            raise UnreadableMessage(f'{path_of(*path)} answered without "{inside}"')
        answer = answer[inside]
    try:
        return kind.model_validate(answer)
    except ValidationError as error:
        first = error.errors()[0]
        raise UnreadableMessage(
            f"the server's answer is no {kind.__name__}: {first['msg']} at {first['loc']}"
        ) from error
