"""`lumiline serve`: runs the service under uvicorn."""

import copy
import gc
import logging.config
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Final

import typer
from pydantic import ValidationError
from pydantic_core import ErrorDetails

from service.settings import Settings

_KNOWN: Final = tuple(Settings.model_fields)


def run(**given: Any) -> None:
    """Run until interrupted; ends the command with one line when it cannot start.

    Args:
        given: settings from the command line; None: not given.
    """
    settings = load_settings(**given)
    import uvicorn

    from service.app import create_app
    from service.cli.start_check import check_start

    options = server_options(settings)
    with logged(options["log_config"]):
        check_start(settings)
    uvicorn.run(create_app(settings, started=settle_memory), **options)


@contextmanager
def logged(log_config: dict[str, Any]) -> Iterator[None]:
    """Log before uvicorn runs, which then sets up its loggers itself."""
    logging.config.dictConfig(log_config)
    try:
        yield
    finally:
        for name in log_config["loggers"]:
            logging.getLogger(name).handlers.clear()


def settle_memory() -> None:
    """Take all that was made at the start out of the garbage collector's sight.

    A full collection of it holds the interpreter, and every thread, for 100 ms and more; of what
    is made while serving, for a millisecond.
    """
    gc.collect()
    gc.freeze()


def server_options(settings: Settings) -> dict[str, Any]:
    """Return uvicorn's options for these settings."""
    from uvicorn.config import LOGGING_CONFIG

    log_config = copy.deepcopy(LOGGING_CONFIG)
    # Ours in the same form, on standard error.
    level = settings.log_level.upper()
    for name in ("service", "hardware"):
        log_config["loggers"][name] = {"handlers": ["default"], "level": level}
    return {
        "log_config": log_config,
        "host": settings.host,
        "port": settings.port,
        "log_level": settings.log_level,
        # The stream sends binary frames of high entropy at a high rate: compressing them costs
        # time and memory for each client, and gains nothing.
        "ws_per_message_deflate": False,
        "timeout_graceful_shutdown": 5,
    }


def load_settings(**given: Any) -> Settings:
    """Return the settings; ends the command with a clear message when one is wrong."""
    try:
        return Settings(**{name: value for name, value in given.items() if value is not None})
    except ValidationError as error:
        for item in error.errors():
            typer.echo(_complaint(item), err=True)
    except (FileNotFoundError, ValueError) as error:
        typer.echo(f"settings: {error}", err=True)
    raise typer.Exit(2)


def _complaint(item: ErrorDetails) -> str:
    """Say what is wrong with a setting; values that may hold a password are not shown."""
    name = ".".join(str(part) for part in item["loc"])
    if item["type"] == "extra_forbidden":
        return f"setting {name}: there is no such setting; there are {', '.join(_KNOWN)}"
    shown = "" if item["loc"][0] == "database_url" else f", got {item['input']!r}"
    return f"setting {name}: {item['msg']}{shown}"
