"""Address of a server, and how a client authenticates."""

from dataclasses import dataclass
from typing import Final, Literal
from urllib.parse import urlsplit

KeyBy = Literal["header", "subprotocol"]

SUBPROTOCOL: Final = "lumiline.v1"
_BEARER: Final = "lumiline.bearer."


@dataclass(frozen=True)
class Server:
    """A server's address and the key for it.

    Args:
        url: such as ``http://127.0.0.1:8000``, or ``https://`` behind a proxy, with a path where
            the proxy adds one.
        key: an API key, or a token of the server's identity provider; None: none is needed.
        key_by: how a websocket carries it: in the header Authorization, or, where something on
            the way drops that, in a subprotocol as browsers do.
    """

    url: str
    key: str | None = None
    key_by: KeyBy = "header"

    def __post_init__(self) -> None:
        parts = urlsplit(self.url)
        if parts.scheme not in ("http", "https") or not parts.netloc:
            raise ValueError(f'the server is "{self.url}"; give it as http://HOST:PORT')
        if parts.query or parts.fragment or "@" in parts.netloc:
            raise ValueError("the server's address has a query, a fragment or a password in it")
        object.__setattr__(self, "url", self.url.rstrip("/"))

    def __repr__(self) -> str:
        """Return it without the key, which has no place in a log."""
        return f"Server({self.url!r}, key={'***' if self.key else None})"

    @property
    def headers(self) -> dict[str, str]:
        """Headers of a request."""
        return {} if self.key is None else {"Authorization": f"Bearer {self.key}"}

    @property
    def stream_url(self) -> str:
        """Address of the stream, without its query."""
        return f"{self.url.replace('http', 'ws', 1)}/api/v1/stream"

    @property
    def stream_headers(self) -> dict[str, str]:
        """Headers of a websocket's handshake."""
        return self.headers if self.key_by == "header" else {}

    @property
    def stream_subprotocols(self) -> list[str] | None:
        """Subprotocols that a websocket offers; the key is the second of them, if it is there."""
        if self.key is None or self.key_by == "header":
            return None
        return [SUBPROTOCOL, _BEARER + self.key]
