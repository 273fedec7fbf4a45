"""ServerSettings: settings of the OpenIGTLink server."""

from dataclasses import dataclass

from service.settings import Settings


@dataclass(frozen=True)
class ServerSettings:
    """Settings of one server.

    Args:
        host: address that it listens on.
        port: TCP port; 0: any that is free.
        allow: networks whose clients are let in, besides this machine's own.
        device: the device whose tools are sent; None: the first that has any.
        rate_hz: most frames that one client gets a second.
        clients: most clients at the same time.
        stall_s: how long a client may read nothing before it is disconnected [s].
        message_s: how long a client's message may take to arrive [s].
        send_invalid: send poses that are not OK, too, to clients of header version 2.
        changes: clients may change things by commands.
    """

    host: str = "127.0.0.1"
    port: int = 18944
    allow: tuple[str, ...] = ()
    device: str | None = None
    rate_hz: float = 250.0
    clients: int = 16
    stall_s: float = 10.0
    message_s: float = 30.0
    send_invalid: bool = False
    changes: bool = False


def server_settings(settings: Settings) -> ServerSettings | None:
    """Return the OpenIGTLink server's part of the service's settings; None: it is off."""
    if settings.openigtlink_port is None:
        return None
    return ServerSettings(
        settings.openigtlink_host,
        settings.openigtlink_port,
        settings.openigtlink_allow,
        settings.openigtlink_device,
        settings.openigtlink_rate_hz,
        settings.openigtlink_clients,
        settings.openigtlink_stall_s,
        settings.openigtlink_message_s,
        settings.openigtlink_send_invalid,
        settings.openigtlink_changes,
    )
