"""`lumiline serve` and `openapi`: runs the service under uvicorn, prints its interface."""

import asyncio
import gc
import json
import os
import sys
import threading
import webbrowser
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer
from pydantic import ValidationError
from pydantic_core import ErrorDetails

from service.cli.options import ComputeDevice, ProfileOption
from service.settings import Settings

if TYPE_CHECKING:
    from service.station.station_starter import StationStarter

_SETTINGS: Final = tuple(Settings.model_fields)

GC_THRESHOLDS: Final = (10_000, 1_200, 100)
"""Objects more than before, and how many collections of one generation, before the next."""
SWITCH_S: Final = 5e-4
"""How long a request's thread may keep the interpreter from streams: each turn waits for it."""
COLLECT_S: Final = 0.5
"""Time between two collections of young objects."""


def serve(
    host: Annotated[str | None, typer.Option(help="Address to listen on.")] = None,
    port: Annotated[int | None, typer.Option(help="Port to listen on; 0: a free one.")] = None,
    data_dir: Annotated[Path | None, typer.Option(help="Database, recordings, profiles.")] = None,
    profile: ProfileOption = None,
    compute_device: ComputeDevice = None,
    open_browser: Annotated[
        bool, typer.Option("--open", help="Open the dashboard in the browser once all is running.")
    ] = False,
) -> None:
    """Run until interrupted; ends the command with one line when it cannot start."""
    set_private_umask()
    settings = load_settings(
        host=host, port=port, data_dir=data_dir, profile=profile, compute_device=compute_device
    )
    from service.station.station_starter import StationStarter

    with closing(StationStarter()) as starter:
        if settings.station == "process":
            # It loads what a station needs while this process loads what the gateway does.
            starter.launch()
        _serve(settings, starter, open_dashboard if open_browser else None)


def _serve(
    settings: Settings, starter: "StationStarter", listening: Callable[[str], None] | None
) -> None:
    from service.application import shutdown
    from service.application.app import create_app
    from service.cli import preflight
    from service.logs import configured_logging

    preflight.check_ports(settings)
    sys.setswitchinterval(SWITCH_S)
    with configured_logging(settings):
        preflight.check_startup(settings)
        preflight.create_bootstrap_key(settings)
        app = create_app(settings, started=begin_gc, starter=starter)
        shutdown.run_server(app, server_options(settings), listening)


def open_dashboard(url: str) -> None:
    """Open the dashboard in the browser; some browsers keep their caller until they end."""
    threading.Thread(target=webbrowser.open, args=(url,), name="browser", daemon=True).start()


def openapi() -> None:
    """Print the OpenAPI document; nothing is opened or started."""
    from service.application.app import create_app

    typer.echo(json.dumps(create_app(load_settings()).openapi(), indent=2, ensure_ascii=False))


def set_private_umask() -> None:
    """Let files that this process makes be its user's alone, in the data directory above all."""
    os.umask(os.umask(0o077) | 0o077)


def begin_gc() -> None:
    """Keep the garbage collector from holding up streams; called in the event loop.

    Objects count as young until the next collection, whatever is freed meanwhile: without one,
    all that streams keep becomes young, and a hundred clients that connect bring a collection of
    80 ms. So young ones are collected often, and older ones every ten minutes or so.
    """
    freeze_gc()
    collect_young()


def collect_young() -> None:
    """Collect young objects now, and again and again; called in the event loop."""
    gc.collect(0)
    asyncio.get_running_loop().call_later(COLLECT_S, collect_young)


def freeze_gc() -> None:
    """Take all that was made at the start out of the garbage collector's sight.

    A full collection of it takes 100 ms and more, in which no thread runs. What streams keep of the
    last seconds is not garbage either, some ten objects a frame. Reference counts free what the
    live path lets go; cycles are left by requests that failed and by clients that have gone.
    """
    gc.collect()
    gc.freeze()
    gc.set_threshold(*GC_THRESHOLDS)


def server_options(settings: Settings) -> dict[str, Any]:
    """Return uvicorn's options for these settings."""
    return {
        # Ours, in service/logs: one form for all loggers, and a line for each request.
        "log_config": None,
        "access_log": False,
        "host": settings.host,
        "port": settings.port,
        "log_level": settings.log_level,
        # The stream sends binary frames of high entropy at a high rate: compressing them costs
        # time and memory for each client, and gains nothing.
        "ws_per_message_deflate": False,
        "timeout_graceful_shutdown": 5,
        "limit_concurrency": settings.connections,
        "http": "service.application.http_limits:LimitedHttpProtocol",
        "ws": "service.application.websocket_limits:LimitedWebSocketProtocol",
        # Of a proxy nothing is believed that no setting says is there: see docs/how-to/security.md.
        "proxy_headers": bool(settings.trusted_proxies),
        "forwarded_allow_ips": list(settings.trusted_proxies),
    }


def load_settings(**options: Any) -> Settings:
    """Return the settings; ends the command with a clear message when one is wrong."""
    try:
        return Settings(**{name: value for name, value in options.items() if value is not None})
    except ValidationError as error:
        for item in error.errors():
            typer.echo(_complaint(item), err=True)
    except (FileNotFoundError, ValueError) as error:
        typer.echo(f"settings: {error}", err=True)
    raise typer.Exit(2)


def _complaint(item: ErrorDetails) -> str:
    """Say what is wrong with a setting; values that may hold a password are not shown."""
    if not item["loc"]:  # of several settings together; what was given is all of them
        return f"settings: {item['msg'].removeprefix('Value error, ')}"
    name = ".".join(str(part) for part in item["loc"])
    if item["type"] == "extra_forbidden":
        return f"setting {name}: there is no such setting; there are {', '.join(_SETTINGS)}"
    input_text = "" if item["loc"][0] in ("database_url", "bus_url") else f", got {item['input']!r}"
    return f"setting {name}: {item['msg']}{input_text}"
