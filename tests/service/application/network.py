"""Machines of a test: network namespaces with links that are cut, and a way to PostgreSQL."""

import ctypes
import os
import select
import shutil
import socket
import subprocess
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Final

import pytest
from sqlalchemy.engine import make_url

_CLONE_NEWNET: Final = 0x40000000
_NETWORK: Final = "10.213.77"
"""Addresses within the namespaces; nobody else sees them."""


def _ip(*words: str, check: bool = True) -> int:
    return subprocess.run(["ip", *words], check=check, capture_output=True).returncode


def _enter(descriptor: int) -> None:
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.setns(descriptor, _CLONE_NEWNET) != 0:
        raise OSError(ctypes.get_errno(), "setns")


class Network:
    """Machines on one switch, which is that of the first; this process is a machine, too.

    Args:
        names: of the machines; the first has the broker and the way to PostgreSQL.
        delay_ms: of each link, where the kernel can delay.
        loss_percent: of each link, likewise.
    """

    def __init__(
        self, names: tuple[str, ...], delay_ms: float = 0.5, loss_percent: float = 0.1
    ) -> None:
        if os.geteuid() != 0 or shutil.which("ip") is None:
            pytest.skip("network namespaces need root, and the command ip")
        self._tag = f"ll{os.getpid() % 100_000:x}"
        self.names = names
        self._made: list[str] = []
        self.delayed = False
        try:
            self._make(delay_ms, loss_percent)
        except (subprocess.CalledProcessError, OSError) as error:
            self.close()
            pytest.skip(f"network namespaces cannot be made here: {error}")

    def _make(self, delay_ms: float, loss_percent: float) -> None:
        hub = self._namespace(self.names[0])
        for name in self.names:
            space = self._namespace(name)
            if _ip("netns", "add", space, check=False) == 0:
                self._made.append(space)
            _ip("-n", space, "link", "set", "lo", "up")
        _ip("-n", hub, "link", "add", "switch", "type", "bridge")
        _ip("-n", hub, "addr", "add", f"{self.address(self.names[0])}/24", "dev", "switch")
        _ip("-n", hub, "link", "set", "switch", "up")
        for name in self.names[1:]:
            space = self._namespace(name)
            _ip(
                "-n",
                hub,
                "link",
                "add",
                name,
                "type",
                "veth",
                "peer",
                "name",
                "eth0",
                "netns",
                space,
            )
            _ip("-n", hub, "link", "set", name, "master", "switch")
            _ip("-n", hub, "link", "set", name, "up")
            _ip("-n", space, "addr", "add", f"{self.address(name)}/24", "dev", "eth0")
            _ip("-n", space, "link", "set", "eth0", "up")
            words = f"netns exec {hub} tc qdisc add dev {name} root netem delay {delay_ms}ms"
            self.delayed = _ip(*words.split(), "loss", f"{loss_percent}%", check=False) == 0

    def _namespace(self, name: str) -> str:
        return f"{self._tag}-{name}"

    def address(self, name: str) -> str:
        """Return the address of a machine."""
        return f"{_NETWORK}.{1 + self.names.index(name)}"

    @contextmanager
    def on(self, name: str) -> Iterator[None]:
        """Let this thread be on a machine: its sockets, and processes that it starts."""
        before = os.open("/proc/thread-self/ns/net", os.O_RDONLY)
        descriptor = os.open(f"/run/netns/{self._namespace(name)}", os.O_RDONLY)
        try:
            _enter(descriptor)
            yield
        finally:
            _enter(before)
            os.close(descriptor)
            os.close(before)

    def cut(self, name: str) -> None:
        """Cut a machine's link: nobody is told, as with a cable that is pulled behind a switch."""
        _ip("-n", self._namespace(self.names[0]), "link", "set", name, "nomaster")

    def join(self, name: str) -> None:
        """Join it again."""
        _ip("-n", self._namespace(self.names[0]), "link", "set", name, "master", "switch")

    def close(self) -> None:
        """Remove all machines."""
        for space in self._made:
            _ip("netns", "del", space, check=False)


class DatabaseProxy:
    """The tests' PostgreSQL as machines of a network reach it, at the first one.

    Args:
        network: of the machines.
        url: of the database, as it is reached from here.
    """

    def __init__(self, network: Network, url: str) -> None:
        target = make_url(url)
        self._target = (target.host or "127.0.0.1", target.port or 5432)
        with network.on(network.names[0]):
            self._listener = socket.create_server((network.address(network.names[0]), 5432))
        host = network.address(network.names[0])
        self.url = target.set(host=host, port=5432).render_as_string(hide_password=False)
        self.refuses = False
        """Whether new connections are ended at once."""
        self._threads = [threading.Thread(target=self._accept)]
        self._open: list[socket.socket] = []
        self._threads[0].start()

    def _accept(self) -> None:
        while True:
            try:
                near, _ = self._listener.accept()
            except OSError:
                return
            if self.refuses:
                near.close()
                continue
            far = socket.create_connection(self._target)
            self._open += [near, far]
            self._threads.append(threading.Thread(target=_pass_on, args=(near, far)))
            self._threads[-1].start()

    def cut(self) -> None:
        """Let nobody reach it, as if the server had ended."""
        self.refuses = True
        for one in self._open:
            with suppress(OSError):
                one.shutdown(socket.SHUT_RDWR)

    def join(self) -> None:
        """Let all reach it again."""
        self.refuses = False

    def close(self) -> None:
        """End it."""
        self.cut()
        with suppress(OSError):
            self._listener.shutdown(socket.SHUT_RDWR)
        for thread in tuple(self._threads):
            thread.join()
        self._listener.close()


def _pass_on(near: socket.socket, far: socket.socket) -> None:
    """Pass on what comes from either, until one of them ends."""
    others = {near: far, far: near}
    with near, far, suppress(OSError):
        while True:
            for one in select.select(list(others), [], [])[0]:
                data = one.recv(65536)
                if not data:
                    return
                others[one].sendall(data)
