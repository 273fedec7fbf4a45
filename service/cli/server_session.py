"""Session of a command that is a client of a running server."""

from collections.abc import Iterator
from contextlib import contextmanager

from lumiline.client import Client
from lumiline.client.errors import ClientError
from service.cli.output import fail


@contextmanager
def client_session(url: str, key: str | None, timeout_s: float = 30.0) -> Iterator[Client]:
    """Yield a client; what the server refuses ends the command with its reason."""
    try:
        with Client(url, key, timeout_s=timeout_s) as client:
            yield client
    except ClientError as error:
        raise fail(str(error)) from None
