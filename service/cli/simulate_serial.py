"""`lumiline simulate-serial`: a simulated device behind a TCP port or a pseudo-terminal."""

import re
import signal
import socket
import time
from dataclasses import replace
from pathlib import Path
from threading import Event
from typing import Annotated

import typer

from hardware.serial.emulator import serve_socket, serve_terminal
from hardware.serial.simulated_device import SimulatedSerialDevice
from hardware.simulated.settings import SimulationSettings
from service.cli.json_files import read_settings
from service.cli.options import AsJson, RateHz, SimulationOption, refuse_unused
from service.cli.output import fail, print_json, say


def simulate_serial(
    context: typer.Context,
    listen: Annotated[str | None, typer.Option(help="HOST:PORT to be reached at.")] = None,
    pty: Annotated[bool, typer.Option("--pty", help="Be a pseudo-terminal instead.")] = False,
    link: Annotated[
        Path | None, typer.Option(help="Of a pseudo-terminal: a symbolic link to make.")
    ] = None,
    rate_hz: RateHz = None,
    cycle: Annotated[
        int | None, typer.Option(min=1, help="Number of exposures to render and repeat.")
    ] = None,
    part: Annotated[
        int | None, typer.Option(min=1, help="Counts in a message; left out: an exposure's all.")
    ] = None,
    simulation: SimulationOption = None,
    as_json: AsJson = False,
) -> None:
    """Serve the device until interrupted."""
    if (listen is None) == (not pty):
        raise fail("give one of --listen HOST:PORT and --pty")
    if not pty:
        refuse_unused(context, "without --pty", "link")
    if link is not None and link.exists() and not link.is_symlink():
        raise fail(f"{link} exists and is no symbolic link; choose another name")
    ended = Event()
    handlers = {
        number: signal.signal(number, lambda *_: ended.set())
        for number in (signal.SIGINT, signal.SIGTERM)
    }
    try:
        chosen = read_settings(SimulationSettings, simulation)
        if rate_hz is not None:
            chosen = replace(chosen, frame_rate_hz=rate_hz)

        on_ns = time.monotonic_ns()

        def make(_: int) -> SimulatedSerialDevice:
            return SimulatedSerialDevice(chosen, on_ns, rendered=cycle, part_counts=part)

        def say_where(url: str) -> None:
            if as_json:
                path = None if link is None else str(link)
                # By this machine's monotonic clock: where the device's own begins.
                print_json({"url": url, "link": path, "switched_on_ns": on_ns})
            else:
                say(f"the device is at {url}" + (f", also {link}" if link else ""))

        if listen is None:
            serve_terminal(make, link, ended, say_where)
        else:
            with socket.create_server(_address(listen)) as listener:
                host, port = listener.getsockname()[:2]
                say_where(f"socket://{host}:{port}")
                serve_socket(make, listener, ended)
    except OSError as error:
        raise fail(f"{listen or link or 'the terminal'}: {error.strerror or error}") from error
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)


def _address(text: str) -> tuple[str, int]:
    match = re.fullmatch(r"([A-Za-z0-9.-]+):([0-9]{1,5})", text)
    if match is None or int(match[2]) > 65535:
        raise fail(f"--listen is {text!r}; it must be HOST:PORT, as 127.0.0.1:5000")
    return match[1], int(match[2])
