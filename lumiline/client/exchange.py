"""Client methods as exchanges: written once without I/O, run by either client."""

import inspect
from collections.abc import Callable, Coroutine, Generator, Mapping, Sequence
from dataclasses import dataclass
from functools import wraps
from pathlib import Path
from types import MethodType
from typing import (
    Any,
    Concatenate,
    Final,
    Generic,
    ParamSpec,
    Self,
    TypeAlias,
    TypeVar,
    get_args,
    overload,
)
from urllib.parse import quote

from pydantic import BaseModel, ValidationError

from lumiline.client.errors import UnreadableMessage

P = ParamSpec("P")
T = TypeVar("T")
Model = TypeVar("Model", bound=BaseModel)

API_ROOT: Final = "/api/v1"
PAGE_SIZE: Final = 200
"""Items that a page of a list has at most."""


@dataclass(frozen=True)
class HttpRequest:
    """Send a request; the answer is its JSON.

    Args:
        method: of HTTP.
        path: from the server's root; the other arguments are those of ``send``.
        timeout_s: how long the answer is waited for [s]; None: as the client says.
    """

    method: str
    path: str
    query: Mapping[str, Any] | None = None
    body: Any = None
    timeout_s: float | None = None
    extra_timeout_s: float = 0.0


@dataclass(frozen=True)
class Download:
    """Write what a GET answers to a file; the answer is the file's path."""

    source: str
    path: Path


@dataclass(frozen=True)
class Pause:
    """Wait [s]."""

    seconds: float


Exchange: TypeAlias = Generator[Any, Any, T]
"""A generator that yields steps of input and output, is sent their results, and returns T."""


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


class _Runner:
    """Runs exchanges: performs their steps, by blocking calls or with asyncio."""

    def _perform(self, step: Any) -> Any:
        """Return the result of a step, or what it is awaited for."""
        raise NotImplementedError

    async def _drive(self, exchange: Exchange[T]) -> T:
        try:
            step = next(exchange)
            while True:
                try:
                    answer = await result_of(self._perform(step))
                except Exception as error:  # noqa: BLE001  # the exchange decides
                    step = exchange.throw(error)
                else:
                    step = exchange.send(answer)
        except StopIteration as end:
            result: T = end.value
            return result


class BlockingRunner(_Runner):
    """Runs exchanges by blocking calls; a context manager that closes what it opened."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *raised: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the connection."""
        raise NotImplementedError

    def _run(self, exchange: Exchange[T]) -> T:
        return finish(self._drive(exchange))


class AsyncRunner(_Runner):
    """Runs exchanges with asyncio; an asynchronous context manager."""

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *raised: object) -> None:
        await self.close()

    async def close(self) -> None:
        """Close the connection."""
        raise NotImplementedError

    async def _run(self, exchange: Exchange[T]) -> T:
        return await self._drive(exchange)


class ClientMethod(Generic[P, T]):
    """A method of both clients: blocking in the one, a coroutine function in the other.

    Args:
        define: the method's parameters and documentation; returns its exchange.
    """

    def __init__(self, define: Callable[Concatenate[Any, P], Exchange[T]]) -> None:
        @wraps(define)
        def blocking(client: BlockingRunner, *args: P.args, **named: P.kwargs) -> T:
            return client._run(define(client, *args, **named))

        @wraps(define)
        async def awaitable(client: AsyncRunner, *args: P.args, **named: P.kwargs) -> T:
            return await client._run(define(client, *args, **named))

        # help() and Sphinx show the result, not the exchange that leads to it.
        signature = inspect.signature(define)
        result = get_args(signature.return_annotation)[-1]
        for function in (blocking, awaitable):
            del vars(function)["__wrapped__"]
            vars(function)["__signature__"] = signature.replace(return_annotation=result)
            function.__annotations__ = {**define.__annotations__, "return": result}
        self._blocking, self._awaitable = blocking, awaitable

    @overload
    def __get__(self, client: None, owner: type[Any]) -> Callable[..., Any]: ...
    @overload
    def __get__(self, client: BlockingRunner, owner: type[Any]) -> Callable[P, T]: ...
    @overload
    def __get__(
        self, client: AsyncRunner, owner: type[Any]
    ) -> Callable[P, Coroutine[Any, Any, T]]: ...

    def __get__(
        self, client: BlockingRunner | AsyncRunner | None, owner: type[Any]
    ) -> Callable[..., Any]:
        """Return the method, bound to a client where there is one."""
        function = self._awaitable if issubclass(owner, AsyncRunner) else self._blocking
        return function if client is None else MethodType(function, client)


def get(kind: type[Model], *path: str, inside: str | None = None, **query: Any) -> Exchange[Model]:
    """Get what is at a path below the interface's root; arguments as of ``send``."""
    return send(kind, "GET", *path, inside=inside, **query)


def get_all(kind: type[Model], *path: str, **query: Any) -> Exchange[list[Model]]:
    """Get a list whole, page by page; raises UnreadableMessage."""
    found: list[Model] = []
    while True:
        page = yield HttpRequest(
            "GET", path_of(*path), {**query, "limit": PAGE_SIZE, "offset": len(found)}
        )
        if (
            not isinstance(page, dict)
            or not isinstance(page.get("items"), list)
            or not isinstance(page.get("total"), int)
        ):
            raise UnreadableMessage(f"{path_of(*path)} did not answer a list")
        found += [_read(kind, item, path) for item in page["items"]]
        if not page["items"] or len(found) >= page["total"]:
            return found


def send(
    kind: type[Model],
    method: str,
    *path: str,
    body: Mapping[str, Any] | None = None,
    inside: str | None = None,
    extra_timeout_s: float = 0.0,
    **query: Any,
) -> Exchange[Model]:
    """Send a request, and return what is answered.

    Args:
        kind: model that the answer is read as.
        method: of HTTP.
        path: parts of the path below the interface's root.
        body: sent as JSON; None: nothing.
        inside: member of the answer that is wanted; None: all of it.
        extra_timeout_s: how long the server measures or computes besides [s].
        query: parameters; those that are None are left out.
    """
    answer = yield HttpRequest(method, path_of(*path), query, body, extra_timeout_s=extra_timeout_s)
    return _read(kind, answer, path, inside)


def delete(*path: str) -> Exchange[None]:
    """Delete what is at a path below the interface's root."""
    yield HttpRequest("DELETE", path_of(*path))


def download(file: Path | str, *path: str) -> Exchange[Path]:
    """Write what is at a path below the interface's root to a file, and return its path."""
    written: Path = yield Download(path_of(*path), Path(file))
    return written


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
