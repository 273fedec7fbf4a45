"""Gateways of one database: who lives, who has a lease, and how changes are followed."""

from _thread import start_new_thread
from collections.abc import Callable, Iterator
from pathlib import Path
from threading import Event
from typing import Any

import pytest

from service.database import gateway
from service.database.engine import Database
from service.database.gateway import DEVICES, Gateway, SharedGateway, directory_identity
from service.database.migration import migrate
from service.database.stored_files import StoredFiles
from tests.service.conftest import postgres_schema

pytestmark = pytest.mark.postgres

Make = Callable[[str], SharedGateway]


class Clock:
    """The monotonic clock of a test."""

    now_s = 1000.0

    def monotonic(self) -> float:
        return self.now_s

    def sleep(self, seconds: float) -> None:
        self.now_s += seconds


@pytest.fixture(scope="module")
def shared_database() -> Iterator[Database]:
    for url in postgres_schema():
        database = Database(url)
        migrate(database)
        yield database
        database.close()


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    made = Clock()
    monkeypatch.setattr(gateway, "time", made)
    monkeypatch.setattr(gateway, "_runs", lambda _: True)
    return made


@pytest.fixture
def make(
    shared_database: Database, clock: Clock, monkeypatch: pytest.MonkeyPatch
) -> Iterator[Make]:
    """Makes gateways whose beats the test makes; ``beat`` is one."""
    monkeypatch.setattr("threading.Thread.start", lambda _: None)

    def made(name: str) -> SharedGateway:
        one = SharedGateway(shared_database, f"directory-{name}", name)
        one.join([DEVICES, one.files_lease])
        return one

    yield made
    with shared_database.engine.begin() as connection:
        for table in ("gateways", "leases", "device_changes", "stored_files"):
            connection.exec_driver_sql(f"DELETE FROM {table}")


def beat(*gateways: SharedGateway) -> None:
    for one in gateways:
        connection = one._connect()
        one._beat(connection)
        connection.close()


def test_first_has_the_devices_and_each_its_directory(make: Make) -> None:
    a, b = make("a"), make("b")
    beat(a, b)
    assert [one.holds(DEVICES) for one in (a, b)] == [True, False]
    assert [one.holds(one.files_lease) for one in (a, b)] == [True, True]
    assert [one.holder(DEVICES) for one in (a, b)] == ["a", "a"]
    assert a.others
    assert b.others


def test_lease_of_one_that_beats_no_more_is_taken(make: Make, clock: Clock) -> None:
    a, b = make("a"), make("b")
    woken: list[int] = []
    b.watch(lambda: woken.append(1))
    for _ in range(20):  # both beat: nothing changes hands
        clock.now_s += gateway.BEAT_S
        beat(a, b)
    assert a.holds(DEVICES)
    woken.clear()
    clock.now_s += gateway.DEAD_AFTER_S - 0.5
    beat(b)
    assert not b.holds(DEVICES)
    clock.now_s += 1.0
    beat(b)
    assert b.holds(DEVICES)
    assert woken
    assert b.holder(DEVICES) == "b"
    beat(a)  # it lived after all: it is one of them again, without the devices
    assert [one.holds(DEVICES) for one in (a, b)] == [False, True]
    assert a.holds(a.files_lease)


def test_one_that_was_held_up_itself_buries_nobody(make: Make, clock: Clock) -> None:
    a, b = make("a"), make("b")
    beat(a, b)
    clock.now_s += 100.0
    beat(b)  # A has not beaten: as B, it may just be going on
    assert not b.holds(DEVICES)
    beat(a)
    assert a.holds(DEVICES)


def test_process_that_is_gone_from_this_machine_is_seen_at_once(
    make: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    make("a")
    monkeypatch.setattr(gateway, "_runs", lambda _: False)
    assert make("b").holds(DEVICES)


def test_lease_is_free_for_those_who_may_have_it_only(
    shared_database: Database, make: Make
) -> None:
    none = SharedGateway(shared_database, "d", "none")
    none.join([none.files_lease])
    assert none.holder(DEVICES) is None
    assert make("a").holds(DEVICES)
    beat(none)
    assert not none.holds(DEVICES)


def test_one_that_leaves_is_gone_at_once(make: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    a, b = make("a"), make("b")
    monkeypatch.setattr("threading.Thread.join", lambda *_: None)
    a.leave()
    beat(b)
    assert b.holds(DEVICES)
    assert not b.others


def test_change_of_a_device_elsewhere_is_numbered_and_followed(
    make: Make, shared_database: Database, clock: Clock
) -> None:
    a, b = make("a"), make("b")
    with shared_database.write() as session:
        assert a.announce_change(session, "sim") is None
        first = b.announce_change(session, "sim")
        second = b.announce_change(session, "sim")
    assert (first, second) == (1, 2)
    assert a.changes() == [("sim", 2)]
    a.followed("sim", 1)
    assert b.wait_followed("sim", 1)
    assert a.changes() == [("sim", 2)]
    b._ended.wait = lambda seconds: clock.sleep(seconds)  # type: ignore[method-assign]
    before = clock.now_s
    assert not b.wait_followed("sim", 2)
    assert clock.now_s > before + gateway.FOLLOW_S
    before = clock.now_s
    with shared_database.engine.begin() as connection:
        connection.exec_driver_sql("DELETE FROM leases")  # nobody has the devices: nobody follows
    assert not b.wait_followed("sim", 2)
    assert clock.now_s == before
    a.followed("sim", 2)
    assert b.wait_followed("sim", 2)
    assert a.changes() == []


def test_lease_is_not_taken_while_its_owner_changes_a_device(
    make: Make, shared_database: Database, clock: Clock
) -> None:
    a, b = make("a"), make("b")
    beat(b)
    clock.now_s += gateway.DEAD_AFTER_S + 1.0
    b._beaten_s = clock.now_s
    with shared_database.write() as session:
        assert a.announce_change(session, "sim") is None
        connection = b._connect()
        connection.execute("SET lock_timeout = 100")
        with pytest.raises(Exception, match="lock timeout"):
            b._beat(connection)
        connection.close()
    beat(b)
    assert b.holds(DEVICES)


def files(database: Database, one: Gateway) -> StoredFiles:
    return StoredFiles(database, one, "recording")


def test_files_are_listed_while_a_gateway_lives_that_has_them(
    make: Make, shared_database: Database
) -> None:
    a, b = make("a"), make("b")
    beat(a, b)
    document: dict[str, Any] = {"state": "complete"}
    of_a, of_b = files(shared_database, a), files(shared_database, b)
    of_a.publish({"x.h5": (1, document)}, frozenset)
    assert of_a.others() == {}
    found = of_b.others()["x.h5"]
    assert (found.gateway, found.here, found.document) == ("a", False, document)
    taken = of_b.begin("x.h5", document, 2)
    assert taken == found
    assert of_b.begin("y.h5", document, 2) is None
    assert of_a.other("y.h5") is not None
    of_b.end("y.h5", document, 3)
    of_a.publish({}, frozenset)
    assert of_b.others() == {}
    of_a.publish({"x.h5": (1, document)}, frozenset)
    with shared_database.engine.begin() as connection:
        connection.exec_driver_sql(f"DELETE FROM gateways WHERE id = '{a.id}'")
    assert of_b.others() == {}


def test_file_that_is_begun_while_others_are_listed_stays_listed(
    make: Make, shared_database: Database
) -> None:
    a, b = make("a"), make("b")
    beat(a, b)
    document: dict[str, Any] = {"state": "recording"}
    of_a, of_b = files(shared_database, a), files(shared_database, b)
    begun = Event()

    def begin() -> None:
        of_a.begin("x.h5", document, 1)
        begun.set()

    def written_now() -> frozenset[str]:
        start_new_thread(begin, ())  # gateways start no threads here
        begun.wait(0.3)  # it waits; were it not to wait, it would be through by then
        return frozenset()

    of_a.publish({}, written_now)
    assert begun.wait(60.0)
    found = of_b.other("x.h5")
    assert found is not None
    assert found.document == document


def test_file_in_a_shared_directory_is_of_who_writes_it(
    make: Make, shared_database: Database
) -> None:
    a = make("a")
    b = SharedGateway(shared_database, a.directory_id, "b")
    b.join([b.files_lease])
    beat(a, b)
    document: dict[str, Any] = {"state": "recording"}
    of_a, of_b = files(shared_database, a), files(shared_database, b)
    of_b.begin("x.h5", document, 1)
    written = of_a.other("x.h5")
    assert written is not None
    assert written.here
    of_a.publish({"x.h5": (1, {"state": "incomplete"})}, frozenset)  # A tidies, and leaves it
    written = of_a.other("x.h5")
    assert written is not None
    assert written.document == document
    of_b.end("x.h5", {"state": "complete"}, 2)
    assert of_a.others() == {}
    assert of_b.others() == {}


def test_directory_keeps_its_identity(tmp_path: Path) -> None:
    first = directory_identity(tmp_path)
    assert directory_identity(tmp_path) == first
    other = tmp_path / "other"
    other.mkdir()
    assert directory_identity(other) != first


def test_only_server_has_everything(shared_database: Database) -> None:
    alone = Gateway()
    assert alone.holds(DEVICES)
    assert alone.holder(DEVICES) == alone.name
    assert not alone.others
    with shared_database.read() as session:
        assert alone.announce_change(session, "sim") is None
    assert alone.changes() == []
