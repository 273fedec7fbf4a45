"""Serial ports by URL: immediate reads, and a close signal from any thread.

A URL is what pyserial takes: ``/dev/ttyACM0``, ``COM3``, ``rfc2217://host:port``, and
``socket://host:port``. A socket is opened here and not by pyserial, whose reads wait until all
that was asked for has come, and whose close sleeps for 0.3 s. Where there is a file descriptor it
is read directly: what has come, in one call, as soon as it comes.
"""

import errno
import os
import selectors
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from threading import Event
from typing import Any, Final, Protocol
from urllib.parse import urlsplit

import serial

from hardware.errors import DeviceNotConnected
from hardware.name_lookup import connect_to_any, lookup

READ_BYTES: Final = 2**18
CONNECT_S: Final = 2.0
WRITE_S: Final = 1.0
_POLL_S: Final = 0.05


class PortDisconnected(Exception):
    """The port is gone; the message says why."""


class CloseSignal:
    """Thread-safe close request that wakes a thread waiting for bytes."""

    def __init__(self) -> None:
        self.event = Event()
        self._read, self._write = socket.socketpair()

    def set(self) -> None:
        """Request the close; irrevocable."""
        if not self.event.is_set():
            self.event.set()
            with suppress(OSError):
                self._write.send(b"\0")

    def is_set(self) -> bool:
        """Whether the close was requested."""
        return self.event.is_set()

    def wait(self, seconds: float) -> bool:
        """Wait at most ``seconds``; return whether the close was requested."""
        return self.event.wait(seconds)

    def fileno(self) -> int:
        """Return a descriptor that becomes readable on the close request."""
        return self._read.fileno()

    def close(self) -> None:
        """Release the descriptors; call when no thread waits."""
        self.event.set()
        self._read.close()
        self._write.close()


class Port(Protocol):
    """Interface of a port."""

    def read(self, timeout_s: float) -> bytes:
        """Return available bytes, or wait for the first; empty on timeout or closing.

        Raises:
            PortDisconnected: the port is gone.
        """
        ...

    def write(self, data: bytes) -> None:
        """Send bytes; raises PortDisconnected."""
        ...

    def close(self) -> None:
        """Close the port; call from the reading thread, or when there is none."""
        ...


def open_port(url: str, baudrate: int, closing: CloseSignal) -> Port:
    """Open the port of a URL.

    Raises:
        DeviceNotConnected: it does not exist, is in use, or refuses the connection.
    """
    try:
        if url.startswith("socket://"):
            return _SocketPort(_connected(url, closing), closing)
        return _opened(url, baudrate, closing)
    except (OSError, ValueError) as error:  # pyserial's errors are OSErrors
        raise DeviceNotConnected(f"{url} cannot be opened: {_reason(error)}", url=url) from error


def _opened(url: str, baudrate: int, closing: CloseSignal) -> Port:
    if not url.startswith("rfc2217://"):
        return _open_url(url, baudrate, closing)
    parts = urlsplit(url)

    def connect(address: str) -> Port:
        host = f"[{address}]" if ":" in address else address
        found = parts._replace(netloc=f"{host}:{parts.port}").geturl()
        return _open_url(found, baudrate, closing)

    return connect_to_any(lookup(parts.hostname or ""), connect)


def _open_url(url: str, baudrate: int, closing: CloseSignal) -> Port:
    port = serial.serial_for_url(url, do_not_open=True)
    port.baudrate = baudrate
    port.timeout = 0
    port.write_timeout = WRITE_S
    if isinstance(port, serial.Serial) and os.name == "posix":
        port.exclusive = True
    port.open()
    # FTDI's converters hold bytes back for 16 ms until told otherwise; others refuse this.
    with suppress(AttributeError, OSError, ValueError, NotImplementedError):
        port.set_low_latency_mode(True)
    if isinstance(port, serial.Serial) and os.name == "posix":
        return _DescriptorPort(port, closing)
    port.timeout = _POLL_S
    return _PollingPort(port, closing)


@contextmanager
def _raising_disconnected() -> Iterator[None]:
    try:
        yield
    except (OSError, TypeError) as error:  # pyserial raises TypeError when it is closed meanwhile
        raise PortDisconnected(_reason(error)) from error


class _DescriptorPort:
    """A local port, read through its descriptor."""

    disconnect_reason = "it was unplugged"

    def __init__(self, port: Any, closing: CloseSignal) -> None:
        self._port = port
        self._closing = closing
        self._selector = selectors.DefaultSelector()
        self._key = self._selector.register(port.fileno(), selectors.EVENT_READ)
        self._selector.register(closing, selectors.EVENT_READ)

    def read(self, timeout_s: float) -> bytes:
        with _raising_disconnected():
            ready = self._selector.select(max(0.0, timeout_s))
            if self._closing.is_set() or not any(key is self._key for key, _ in ready):
                return b""
            data = self._receive()
        if not data:
            raise PortDisconnected(self.disconnect_reason)
        return data

    def _receive(self) -> bytes:
        return os.read(self._port.fileno(), READ_BYTES)

    def write(self, data: bytes) -> None:
        with _raising_disconnected():
            self._port.write(data)

    def close(self) -> None:
        self._selector.close()
        with suppress(OSError):
            self._port.close()


class _SocketPort(_DescriptorPort):
    disconnect_reason = "the connection was closed by the other side"

    def _receive(self) -> bytes:
        data: bytes = self._port.recv(READ_BYTES)
        return data

    def write(self, data: bytes) -> None:
        with _raising_disconnected():
            self._port.settimeout(WRITE_S)
            self._port.sendall(data)


class _PollingPort:
    """A port without a descriptor: RFC 2217, and all on Windows. Ends within _POLL_S."""

    def __init__(self, port: serial.Serial, closing: CloseSignal) -> None:
        self._port = port
        self._closing = closing

    def read(self, timeout_s: float) -> bytes:
        end = time.monotonic() + timeout_s
        with _raising_disconnected():
            while not self._closing.is_set():
                data = bytes(self._port.read(max(1, min(self._port.in_waiting, READ_BYTES))))
                if data or time.monotonic() >= end:
                    return data
        return b""

    def write(self, data: bytes) -> None:
        with _raising_disconnected():
            self._port.write(data)

    def close(self) -> None:
        with suppress(OSError):
            self._port.close()


def _connected(url: str, closing: CloseSignal) -> socket.socket:
    """Return a connected socket; waits at most LOOKUP_S for the name and CONNECT_S for the host."""
    parts = urlsplit(url)
    host, port = parts.hostname, parts.port
    if host is None or port is None:
        raise ValueError("it must be socket://HOST:PORT")
    addresses = lookup(host)
    seconds = CONNECT_S / len(addresses)
    return connect_to_any(addresses, lambda one: _connect_socket(one, port, seconds, closing))


def _connect_socket(host: str, port: int, seconds: float, closing: CloseSignal) -> socket.socket:
    """Return a socket that is connected to an address."""
    family, kind, protocol, _, address = socket.getaddrinfo(
        host, port, type=socket.SOCK_STREAM, flags=socket.AI_NUMERICHOST
    )[0]
    connection = socket.socket(family, kind, protocol)
    try:
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        connection.setblocking(False)
        code = connection.connect_ex(address)
        if code not in (0, errno.EINPROGRESS, errno.EWOULDBLOCK):  # no way to such addresses
            raise OSError(code, os.strerror(code))
        with selectors.DefaultSelector() as selector:
            connected = selector.register(connection, selectors.EVENT_WRITE)
            selector.register(closing, selectors.EVENT_READ)
            ready = [key for key, _ in selector.select(seconds)]
        if connected not in ready:
            raise TimeoutError(f"no answer in {seconds:g} s")
        error = connection.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR)
        if error:
            raise OSError(error, os.strerror(error))
    except BaseException:
        connection.close()
        raise
    return connection


def _reason(error: Exception) -> str:
    """Return the operating system's error message, where there is one."""
    if isinstance(error, OSError) and error.errno is not None and error.errno > 0:
        return os.strerror(error.errno)
    return str(error) or type(error).__name__
