"""Failed log-ins: so many for each address, then a wait; never more memory than is set."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from service.application.app import create_app
from service.security.login_throttle import LoginThrottle, network
from service.settings import Settings
from tests.service.fake_pipeline import FakePipeline, TestClient
from tests.service.security.conftest import Secured, bearer


class Clock:
    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        return self.now


def test_so_many_then_a_wait_that_passes() -> None:
    clock = Clock()
    attempts = LoginThrottle(6, clock)
    for _ in range(6):
        assert attempts.wait_s("10.0.0.1") == 0
        attempts.failed("10.0.0.1")
    assert attempts.wait_s("10.0.0.1") == 10
    assert attempts.wait_s("10.0.0.2") == 0
    clock.now = 9.9
    assert attempts.wait_s("10.0.0.1") == 1
    clock.now = 10.0
    assert attempts.wait_s("10.0.0.1") == 0
    attempts.failed("10.0.0.1")
    assert attempts.wait_s("10.0.0.1") == 10
    clock.now = 100.0
    assert attempts.wait_s("10.0.0.1") == 0


@given(st.integers(0, 2**64 - 1), st.integers(0, 2**64 - 1))
def test_one_network_of_ipv6_is_one_address(one: int, other: int) -> None:
    import ipaddress

    prefix = 0x20010DB8 << 96
    addresses = [str(ipaddress.IPv6Address(prefix + low)) for low in (one, other)]
    assert network(addresses[0]) == network(addresses[1])
    assert network(f"::ffff:10.0.{one % 256}.1") == f"10.0.{one % 256}.1"


@given(st.lists(st.text(max_size=200), max_size=30))
@settings(max_examples=15)
def test_memory_is_bounded_whatever_the_addresses(addresses: list[str]) -> None:
    attempts = LoginThrottle(1, Clock(), max_addresses=10)
    for address in addresses:
        attempts.failed(address)
        assert len(attempts) <= 10
        assert attempts.wait_s(address) > 0
    assert all(len(network(address)) <= 64 for address in addresses)


@pytest.mark.slow
def test_a_server_lets_an_address_wait(tmp_path) -> None:
    given_settings = Settings(data_dir=tmp_path, failed_logins_per_minute=3)
    with TestClient(create_app(given_settings, FakePipeline())) as client:
        key = Secured(client).key("read:stream")
        for _ in range(3):
            assert client.get("/api/v1/devices", headers=bearer("wrong")).status_code == 401
        for given_key in ("wrong", key[:-1], f"{key[:-1]}-", key[:18] + "x" * 43):
            waits = client.get("/api/v1/devices", headers=bearer(given_key))
            assert waits.status_code == 429
            assert waits.json()["type"] == "/problems/too-many-attempts"
            assert 0 < int(waits.headers["retry-after"]) <= 20
        # Whoever shares the address, and has a valid key, does not wait.
        assert client.get("/api/v1/devices", headers=bearer(key)).status_code == 200
        other = TestClient(client.app, client=("127.0.0.2", 1))
        assert other.get("/api/v1/devices", headers=bearer("wrong")).status_code == 401
