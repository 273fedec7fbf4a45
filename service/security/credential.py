"""Credentials of a request: header or websocket subprotocol; local requests without a key."""

import ipaddress
import re
from typing import Final
from urllib.parse import parse_qsl

from starlette.datastructures import Headers

from service.logs import decoded, redact
from service.problems.errors import CredentialInQuery, QueryTooLong, Unauthenticated
from service.settings import Settings

SUBPROTOCOL: Final = "lumiline.v1"
BEARER_SUBPROTOCOL: Final = "lumiline.bearer."
"""Browsers cannot set headers of a websocket, but they can offer subprotocols."""

MAX_QUERY_BYTES: Final = 4096
"""No operation's query is nearly as long."""

_NAMES: Final = frozenset(
    {"key", "api_key", "apikey", "api-key", "token", "access_token", "bearer", "authorization"}
)
_TOKEN: Final = re.compile(r"[A-Za-z0-9._~+/-]+=*", re.ASCII)


def check_query(query: bytes) -> None:
    """Check that a query is short enough to be read, and has no key in it.

    Raises:
        QueryTooLong: it has more than ``MAX_QUERY_BYTES``.
        CredentialInQuery: it has a key or token; the message does not repeat it.
    """
    if len(query) > MAX_QUERY_BYTES:
        raise QueryTooLong(
            f"the address has a query of {len(query)} bytes; it may have {MAX_QUERY_BYTES}",
            bytes=len(query),
            max_bytes=MAX_QUERY_BYTES,
        )
    pairs = parse_qsl(query.decode("latin-1"), keep_blank_values=True)
    words = decoded("\n".join(word for pair in pairs for word in pair))
    if any(name.lower() in _NAMES for name, _ in pairs) or redact(words) != words:
        raise CredentialInQuery(
            "the address has a key or token in its query, where servers, proxies and browsers "
            "write it down; revoke it if it is a real one, and send another in the header "
            "Authorization: Bearer (a websocket: docs/reference/stream.md)"
        )


def credential_of(headers: Headers, *, websocket: bool) -> str | None:
    """Return the key or token that a request carries, None without one.

    Raises:
        Unauthenticated: there are several, or what there is cannot be one.
    """
    credentials = [_of_header(value) for value in headers.getlist("authorization")]
    if websocket:
        credentials += [
            protocol.removeprefix(BEARER_SUBPROTOCOL)
            for protocol in subprotocols(headers)
            if protocol.startswith(BEARER_SUBPROTOCOL)
        ]
    if len(credentials) > 1:
        raise Unauthenticated("the request carries several keys or tokens; send one")
    return credentials[0] if credentials else None


def subprotocols(headers: Headers) -> list[str]:
    """Return the subprotocols that a client offers."""
    return [
        word.strip()
        for value in headers.getlist("sec-websocket-protocol")
        for word in value.split(",")
        if word.strip()
    ]


def _of_header(value: str) -> str:
    scheme, _, credential = value.strip().partition(" ")
    credential = credential.strip()
    if scheme.lower() != "bearer" or _TOKEN.fullmatch(credential) is None:
        raise Unauthenticated(
            "the header Authorization is not of the form: Bearer, a space, and a key or token"
        )
    return credential


_HOST: Final = re.compile(r"(\[[0-9A-Fa-f:.]+\]|[A-Za-z0-9.-]+)(?::[0-9]{1,5})?", re.ASCII)
_FORWARDED: Final = ("forwarded", "via", "x-real-ip")


def is_loopback(host: str) -> bool:
    """Whether a host name or address is this machine's loopback."""
    if host.lower().rstrip(".") == "localhost":
        return True
    try:
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return False


def keys_required(settings: Settings) -> bool:
    """Whether every client needs a key: asked for, or others than this machine reach the server."""
    return (
        settings.authentication == "required"
        or not is_loopback(settings.host)
        or bool(settings.trusted_proxies)
    )


def why_not_local(settings: Settings, client: str, headers: Headers) -> str | None:
    """Return why a request without a key is not the local administrator's; None: it is.

    A proxy on this machine would make everyone local, so what tells of one is looked for. A web
    page that has its own name resolve to 127.0.0.1 is known by that name, in ``Host``.
    """
    if keys_required(settings):
        return "this server takes requests with a key only"
    if not is_loopback(client):
        return f"the request comes from {client}, and only this machine needs no key"
    for name in headers:
        if name in _FORWARDED or name.startswith("x-forwarded-"):
            return f"the request came through a proxy (header {name})"
    hosts = headers.getlist("host")
    match = _HOST.fullmatch(hosts[0]) if len(hosts) == 1 else None
    if match is None or not is_loopback(match.group(1)):
        text = ", ".join(hosts)[:200]
        return f'the header Host is "{text}", and only localhost or 127.0.0.1 needs no key'
    return None
