"""Checks before the start that the ports of the service are free."""

import errno
import socket
from typing import Final

import typer

from service.settings import Settings

NOT_STARTED: Final = 3
"""Exit code, as of a server that finds out later."""


def check_ports(settings: Settings) -> None:
    """End the command with one line where a port cannot be had; later it would be a traceback.

    Raises:
        typer.Exit: the message was printed; code 3.
    """
    for name, host, port in (
        ("port", settings.host, settings.port),
        ("openigtlink_port", settings.openigtlink_host, settings.openigtlink_port),
        ("ndi_port", settings.ndi_host, settings.ndi_port),
    ):
        reason = _why_not(host, port) if port else None
        if reason is not None:
            typer.echo(
                f"error: setting {name}: cannot listen on {host} port {port}: {reason}", err=True
            )
            raise typer.Exit(NOT_STARTED)


def _why_not(host: str, port: int) -> str | None:
    """Return why none of a name's addresses can be listened on, or one is taken; else None."""
    try:
        found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
    except OSError as error:
        return error.strerror or str(error)
    reasons = []
    for family, kind, protocol, _, address in found:
        try:
            with socket.socket(family, kind, protocol) as probe:
                probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                if family == socket.AF_INET6:
                    probe.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 1)
                probe.bind(address)
        except OSError as error:
            reasons.append(error.strerror or str(error))
            if error.errno == errno.EADDRINUSE:
                return "another program listens there; end it, or choose another port"
    return reasons[0] if len(reasons) == len(found) else None
