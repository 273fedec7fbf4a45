"""Serves a simulated serial device on a TCP port or a pseudo-terminal."""

import os
import selectors
import socket
import time
import tty
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from threading import Event

from hardware.serial.simulated_device import SimulatedSerialDevice

_POLL_S = 0.1
_SEND_S = 0.25

MakeDevice = Callable[[int], SimulatedSerialDevice]
"""Creates a device switched on at a monotonic time [ns]."""


def serve_socket(
    make: MakeDevice, listener: socket.socket, ended: Event, *, stays_on: bool = True
) -> None:
    """Serve one host at a time on a listening socket until ``ended`` is set.

    With ``stays_on`` the device stays on between hosts, else each connection restarts it.
    """
    listener.settimeout(_POLL_S)
    device = make(time.monotonic_ns())
    while not ended.is_set():
        try:
            host, _ = listener.accept()
        except TimeoutError:
            continue
        with host, suppress(OSError):
            host.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            host.settimeout(_SEND_S)
            if not stays_on:
                device = make(time.monotonic_ns())
                host.sendall(device.boot())
            _serve(device, host.fileno(), host.sendall, ended)


def serve_terminal(
    make: MakeDevice, link: Path | None, ended: Event, named: Callable[[str], None]
) -> None:
    """Serve a pseudo-terminal until ``ended`` is set; ``link`` becomes a symbolic link to it.

    ``named`` is called with its name. It persists when the host closes it, as a port does.
    """
    ours, theirs = os.openpty()
    try:
        tty.setraw(theirs)
        os.set_blocking(ours, False)
        name = os.ttyname(theirs)
        if link is not None:
            link.unlink(missing_ok=True)
            link.symlink_to(name)
        named(name)
        device = make(time.monotonic_ns())
        _serve(device, ours, lambda data: _write(ours, data, ended), ended)
    finally:
        if link is not None:
            link.unlink(missing_ok=True)
        os.close(theirs)
        os.close(ours)


def _serve(
    device: SimulatedSerialDevice, descriptor: int, send: Callable[[bytes], None], ended: Event
) -> None:
    """Exchange bytes until the host disconnects; raises OSError."""
    with selectors.DefaultSelector() as selector:
        selector.register(descriptor, selectors.EVENT_READ)
        while not ended.is_set():
            wait_s = (device.due_ns() - time.monotonic_ns()) * 1e-9
            if selector.select(min(max(wait_s, 0.0), _POLL_S)):
                data = os.read(descriptor, 65536)
                if not data:
                    return
                answer = device.receive(data, time.monotonic_ns())
                if answer:
                    send(answer)
            for message in device.send(time.monotonic_ns()):
                send(message)


def _write(descriptor: int, data: bytes, ended: Event) -> None:
    """Write to a terminal that may be full; data not accepted in time are lost."""
    end = time.monotonic() + _SEND_S
    view = memoryview(data)
    while view and time.monotonic() < end and not ended.is_set():
        try:
            view = view[os.write(descriptor, view) :]
        except BlockingIOError:
            time.sleep(0.001)
