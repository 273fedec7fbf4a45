"""Options of the commands that are clients of a running server, and their session with it."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Annotated

import typer

from lumiline.client import Client
from lumiline.client.errors import ClientError
from service.cli.output import fail

HERE = "http://127.0.0.1:8000"
Url = Annotated[str, typer.Option(envvar="LUMILINE_URL", help="The server.", show_default=True)]
Key = Annotated[
    str | None,
    typer.Option(envvar="LUMILINE_KEY", help="API key; better in the variable than here."),
]
DeviceOption = Annotated[str | None, typer.Option(help="Only those of this device.")]
WatchSeconds = Annotated[
    float | None, typer.Option(min=0.1, help="How long; left out: until Ctrl-C.")
]


@contextmanager
def client_session(url: str, key: str | None, timeout_s: float = 30.0) -> Iterator[Client]:
    """Yield a client; what the server refuses ends the command with its reason."""
    try:
        with Client(url, key, timeout_s=timeout_s) as client:
            yield client
    except ClientError as error:
        raise fail(str(error)) from None
