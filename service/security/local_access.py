"""Whether a request without a key is the local administrator's, and why it is not."""

import ipaddress
import re
from typing import Final

from starlette.datastructures import Headers

from service.settings import Settings

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
    given = headers.getlist("host")
    found = _HOST.fullmatch(given[0]) if len(given) == 1 else None
    if found is None or not is_loopback(found.group(1)):
        shown = ", ".join(given)[:200]
        return f'the header Host is "{shown}", and only localhost or 127.0.0.1 needs no key'
    return None
