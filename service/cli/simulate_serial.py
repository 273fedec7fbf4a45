"""`lumiline simulate-serial`: a simulated device behind a TCP port or a pseudo-terminal."""

import re
import signal
import socket
from dataclasses import replace
from pathlib import Path
from threading import Event

from pydantic import TypeAdapter, ValidationError

from compute.errors import LumilineError
from hardware.serial.emulator import serve_socket, serve_terminal
from hardware.serial.simulated_device import SimulatedSerialDevice
from hardware.simulated.settings import SimulationSettings
from service.cli.output import console, fail


def run(
    listen: str | None,
    *,
    terminal: bool,
    link: Path | None,
    rate_hz: float | None,
    cycle: int | None,
    part: int | None,
    settings: Path | None,
) -> None:
    """Serve the device until interrupted."""
    if (listen is None) == (not terminal):
        raise fail("give one of --listen HOST:PORT and --pty")
    if link is not None and link.exists() and not link.is_symlink():
        raise fail(f"{link} exists and is no symbolic link; choose another name")
    ended = Event()
    handlers = {
        number: signal.signal(number, lambda *_: ended.set())
        for number in (signal.SIGINT, signal.SIGTERM)
    }
    try:
        chosen = TypeAdapter(SimulationSettings).validate_json(
            b"{}" if settings is None else settings.read_bytes()
        )
        if rate_hz is not None:
            chosen = replace(chosen, frame_rate_hz=rate_hz)

        def make(now_ns: int) -> SimulatedSerialDevice:
            return SimulatedSerialDevice(chosen, now_ns, rendered=cycle, part_counts=part)

        if terminal:
            also = f", also {link}" if link else ""
            serve_terminal(
                make, link, ended, lambda name: console.print(f"the device is at {name}{also}")
            )
        elif listen is not None:
            with socket.create_server(_address(listen)) as listener:
                host, port = listener.getsockname()[:2]
                console.print(f"the device is at socket://{host}:{port}")
                serve_socket(make, listener, ended)
    except OSError as error:
        raise fail(f"{listen or link or 'the terminal'}: {error.strerror or error}") from error
    except ValidationError as error:
        wrong = (f"{'.'.join(map(str, one['loc']))}: {one['msg']}" for one in error.errors())
        raise fail(f"{settings}: {'; '.join(wrong)}") from error
    except LumilineError as error:
        raise fail(error.detail) from error
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)


def _address(text: str) -> tuple[str, int]:
    match = re.fullmatch(r"([A-Za-z0-9.-]+):([0-9]{1,5})", text)
    if match is None or int(match[2]) > 65535:
        raise fail(f"--listen is {text!r}; it must be HOST:PORT, as 127.0.0.1:5000")
    return match[1], int(match[2])
