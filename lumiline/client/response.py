"""What a response of the server says: JSON, or why it refused; the same for both clients."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

import httpx

from lumiline.client.errors import ServerUnreachable, UnreadableMessage, server_problem


def check(response: httpx.Response, body: bytes) -> None:
    """Raise ServerProblem where the server refused."""
    if not response.is_success:
        retry_after = response.headers.get("Retry-After")
        raise server_problem(response.status_code, body, retry_after)


def json_of(response: httpx.Response, what: str) -> Any:
    """Return the JSON of a response; None where it is empty.

    Args:
        response: that has been read.
        what: was asked, for the message.

    Raises:
        ServerProblem: the server refused.
        UnreadableMessage: it is no JSON.
    """
    check(response, response.content)
    if not response.content:
        return None
    try:
        return response.json()
    except ValueError as error:
        raise UnreadableMessage(f"{what} did not answer JSON") from error


@contextmanager
def connection_errors(what: str) -> Iterator[None]:
    """Raise ServerUnreachable where the connection fails."""
    try:
        yield
    except httpx.TransportError as error:
        raise ServerUnreachable(f"{what}: {error or type(error).__name__}") from error


@contextmanager
def whole_file(path: Path) -> Iterator[IO[bytes]]:
    """Open a file to write, which is there under its name only when all of it was written."""
    part = path.with_name(f"{path.name}.part")
    try:
        with part.open("wb") as file:
            yield file
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)
