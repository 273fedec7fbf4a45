"""Host names are looked up within a time limit, by serial ports and the database alike."""

import socket
from collections.abc import Iterator
from threading import Event
from typing import Any

import psycopg
import pytest

from hardware import name_lookup
from hardware.errors import DeviceNotConnected
from hardware.name_lookup import lookup
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
    assert [lookup(host) for host in ("127.0.0.1", "::1")] == ["127.0.0.1", "::1"]
    assert hanging == []


def test_lookup_of_a_name_returns_its_address_and_unknown_names_raise() -> None:
    assert lookup("localhost") in ("127.0.0.1", "::1")
    with pytest.raises(OSError):
        lookup("no-such-host.invalid")
