"""Client methods, written once as coroutines: awaited by one client, run at once by the other."""

import inspect
from collections.abc import Callable, Coroutine, Hashable, Mapping
from datetime import datetime
from functools import cache, wraps
from pathlib import Path
from types import MethodType
from typing import Any, Concatenate, Final, Generic, ParamSpec, Self, TypeVar, cast, overload
from urllib.parse import quote

from pydantic import BaseModel, TypeAdapter, ValidationError

from lumiline.client.errors import UnreadableMessage

P = ParamSpec("P")
T = TypeVar("T")

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
    """Requests of the server's interface, by their paths from its root."""

    _sleep: Callable[[float], Any]

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
        """Send a request, and return what is answered.

        Args:
            method: of HTTP.
            path: from the server's root.
            params: of the query; those that are None are left out.
            headers: of the request; those that are None are left out.
            body: sent as JSON; None: nothing.
            upload: file that is sent instead.
            timeout_s: how long the answer is waited for [s]; None: as the client says.
            extra_timeout_s: how long the server measures or computes besides [s].
            text: the answer is text, not JSON.
        """
        raise NotImplementedError

    async def _download(
        self,
        method: str,
        file: Path | str,
        path: str,
        *,
        params: Mapping[str, Any] | None = None,
        body: Any = None,
    ) -> Path:
        """Write what is answered to a file, which exists only when it is whole."""
        raise NotImplementedError

    async def _send(self, kind: type[T], method: str, path: str, **request: Any) -> T:
        """Send a request, and return its answer as a type."""
        return _read(kind, await self._request(method, path, **request), path)

    async def _text(self, method: str, path: str, **request: Any) -> str:
        """Send a request, and return its answer as it is."""
        answer: str = await self._request(method, path, text=True, **request)
        return answer

    async def _get_all(
        self,
        kind: type[T],
        path: str,
        *,
        params: Mapping[str, Any] | None = None,
        limit: int | None = None,
    ) -> list[T]:
        """Get a list, page by page: all of it, or its first ``limit`` items.

        Raises:
            UnreadableMessage: the answer is no page of a list.
        """
        found: list[T] = []
        cursor: str | None = None
        while limit is None or len(found) < limit:
            size = PAGE_SIZE if limit is None else min(limit - len(found), PAGE_SIZE)
            part = {**(params or {}), "limit": size, "cursor": cursor}
            page = await self._request("GET", path, params=part)
            match page:
                case {"items": list(items), "next_cursor": str() | None as cursor}:
                    found += [_read(kind, item, path) for item in items]
                case _:
                    raise UnreadableMessage(f"{path} did not answer a list")
            if cursor is None:
                break
        return found


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


def path_of(template: str, *names: str) -> str:
    """Return a path with names in it; those of recordings have slashes, which are part of it."""
    return template.format(*map(quote, names))


def plain(value: Any) -> Any:
    """Return a value of a body as JSON has it: models, arrays, times, files' names.

    Raises:
        TypeError: JSON has nothing like it.
    """
    if isinstance(value, BaseModel):
        return value.model_dump(mode="json")
    if isinstance(value, datetime):
        return value.isoformat()
    if isinstance(value, Path):
        return str(value)
    if hasattr(value, "tolist"):
        return value.tolist()
    raise TypeError(f"a body has a {type(value).__name__}, which JSON has not")


@cache
def _adapter(kind: Any) -> TypeAdapter[Any]:
    return TypeAdapter(kind)


def _read(kind: type[T], answer: Any, path: str) -> T:
    """Return the server's answer as a type."""
    try:
        found: T = _adapter(cast("Hashable", kind)).validate_python(answer)
    except ValidationError as error:
        first = error.errors()[0]
        raise UnreadableMessage(
            f"{path} did not answer a {getattr(kind, '__name__', kind)}: "
            f"{first['msg']} at {first['loc']}"
        ) from error
    return found
