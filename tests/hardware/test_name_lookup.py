"""Host names are looked up within a time limit, by serial ports and the database alike."""

import socket
from collections.abc import Iterator
from threading import Event
from typing import Any
from urllib.parse import urlsplit

import psycopg
import pytest
import serial

from hardware import name_lookup
from hardware.errors import DeviceNotConnected
from hardware.name_lookup import lookup
from hardware.serial import port
from hardware.serial.port import CloseSignal, open_port
from service.database.connection_options import check_names


@pytest.fixture
def hanging(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[str]]:
    """A resolver that does not answer; the names that it was asked for."""
    asked: list[str] = []
    released = Event()

    def getaddrinfo(host: str, *_: Any, **__: Any) -> Any:
        asked.append(host)
        released.wait(240.0)
        raise OSError("released")

    monkeypatch.setattr(name_lookup, "LOOKUP_S", 0.05)
    monkeypatch.setattr(socket, "getaddrinfo", getaddrinfo)
    yield asked
    released.set()


def test_lookup_without_an_answer_raises_and_is_not_begun_again(hanging: list[str]) -> None:
    for _ in range(3):
        with pytest.raises(TimeoutError, match=r"sensor\.example was not resolved in 0\.05 s"):
            lookup("sensor.example")
    assert hanging == ["sensor.example"]


@pytest.mark.parametrize("scheme", ["socket", "rfc2217"])
def test_port_of_a_name_without_an_answer_is_not_connected(hanging: list[str], scheme: str) -> None:
    closing = CloseSignal()
    with pytest.raises(DeviceNotConnected, match="was not resolved"):
        open_port(f"{scheme}://{scheme}.example:4000", 9600, closing)
    closing.close()
    assert hanging == [f"{scheme}.example"]


def test_database_of_a_name_without_an_answer_is_an_operational_error(
    hanging: list[str],
) -> None:
    with pytest.raises(psycopg.OperationalError, match="was not resolved"):
        check_names("/var/run/postgresql,127.0.0.1,db.example")
    assert hanging == ["db.example"]


def test_lookup_of_an_address_asks_nobody(hanging: list[str]) -> None:
    assert [lookup(host) for host in ("127.0.0.1", "::1")] == [("127.0.0.1",), ("::1",)]
    assert hanging == []


def test_lookup_of_a_name_returns_its_address_and_unknown_names_raise() -> None:
    assert set(lookup("localhost")) <= {"127.0.0.1", "::1"}
    with pytest.raises(OSError):
        lookup("no-such-host.invalid")


def test_lookup_of_a_name_of_two_addresses_returns_both_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    found = [(0, 0, 0, "", (one, 0)) for one in ("::1", "127.0.0.1", "::1")]
    monkeypatch.setattr(socket, "getaddrinfo", lambda *_, **__: found)
    assert lookup("both.example") == ("::1", "127.0.0.1")


@pytest.mark.parametrize("scheme", ["socket", "rfc2217"])
@pytest.mark.parametrize("first", ["::1", "100::1", "127.0.0.2"])
def test_port_of_a_name_is_opened_where_somebody_listens(
    monkeypatch: pytest.MonkeyPatch, scheme: str, first: str
) -> None:
    monkeypatch.setattr(port, "lookup", lambda _: (first, "127.0.0.1"))
    monkeypatch.setattr(port, "CONNECT_S", 0.5)
    opened: list[str] = []
    if scheme == "rfc2217":  # its negotiation is the library's

        def open_url(url: str, *_: Any) -> Any:
            opened.append(url)
            if first in url:
                raise serial.SerialException("refused")

        monkeypatch.setattr(port, "_open_url", open_url)
    closing = CloseSignal()
    with socket.create_server(("127.0.0.1", 0)) as server:
        found = open_port(f"{scheme}://both.example:{server.getsockname()[1]}", 9600, closing)
        if scheme == "socket":
            server.accept()[0].close()
            found.close()
        else:
            assert [urlsplit(url).hostname for url in opened] == [first, "127.0.0.1"]
    closing.close()


def test_port_of_a_name_where_nobody_listens_is_not_connected(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(port, "lookup", lambda _: ("::1", "127.0.0.1"))
    with socket.create_server(("127.0.0.1", 0)) as server:
        number = server.getsockname()[1]
    closing = CloseSignal()
    with pytest.raises(DeviceNotConnected, match="Connection refused"):
        open_port(f"socket://both.example:{number}", 9600, closing)
    closing.close()
