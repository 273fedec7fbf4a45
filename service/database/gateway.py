"""Gateway: this server among those on one database; which of them live, and who holds a lease."""

import logging
import os
import secrets
import socket
import threading
import time
from collections.abc import Callable, Iterable
from contextlib import closing, suppress
from pathlib import Path
from typing import Any, Final

from psycopg import Connection
from psycopg import Error as DriverError
from sqlalchemy import ColumnElement, select, text
from sqlalchemy.exc import SQLAlchemyError
from sqlalchemy.orm import InstrumentedAttribute, Session

from service.database.engine import Database
from service.database.models import GatewayRow

_log = logging.getLogger(__name__)

DEVICES: Final = "devices"
"""Lease of the gateway that has the devices of the servers' own stations, and watches over all."""
BEAT_S: Final = 1.0
DEAD_AFTER_S: Final = 5.0
"""A gateway whose beat stood still for so long, while another looked, is taken for dead."""
FOLLOW_S: Final = 5.0
"""How long a change waits for the gateway with the devices to put it into effect."""
_CHANNEL: Final = "lumiline"
_LEASES_LOCK: Final = 5421080
_POLL_S: Final = 0.02


class Gateway:
    """The only server of its database, as on SQLite: it has everything, and tells nobody.

    Args:
        directory_id: of its data directory.
    """

    shared = False
    """Whether there may be others."""

    def __init__(self, directory_id: str = "") -> None:
        self.id = f"{socket.gethostname()}/{os.getpid()}"
        self.name = self.id
        self.directory_id = directory_id

    @property
    def files_lease(self) -> str:
        """Lease of who tidies the data directory, which others may share."""
        return f"files/{self.directory_id}"

    @property
    def others(self) -> bool:
        """Whether other gateways live, as far as it knows."""
        return False

    def holds(self, lease: str) -> bool:  # noqa: ARG002
        """Whether a lease is this gateway's, as far as it knows."""
        return True

    def watches(self, device_id: str) -> bool:  # noqa: ARG002
        """Whether this gateway watches a device and tells others of its events."""
        return self.holds(DEVICES)

    def holder(self, lease: str) -> str | None:  # noqa: ARG002
        """Return the name of the gateway that has a lease; None: nobody has."""
        return self.name

    def watch(self, wake: Callable[[], None]) -> None:
        """Call after whatever other gateways did, and after changes of leases; returns at once."""

    def announce_change(self, session: Session, device_id: str) -> int | None:  # noqa: ARG002
        """Say in a transaction that it changes what a device uses.

        Returns:
            None: the device is this gateway's, and stays so until the transaction ends; else the
            change's number, to be waited for.
        """
        return None

    def wait_followed(self, device_id: str, number: int) -> bool:  # noqa: ARG002
        """Wait until the gateway with the devices has put a change into effect."""
        return True

    def changes(self) -> list[tuple[str, int]]:
        """Return devices that others have changed, and the newest change of each."""
        return []

    def followed(self, device_id: str, number: int) -> None:
        """Say that the changes of a device up to this one are in effect."""

    def is_gone(self, owner: InstrumentedAttribute[Any]) -> ColumnElement[bool] | None:  # noqa: ARG002
        """Return the condition that a column names no gateway that lives; None: that is unknown."""
        return None

    def join(self, leases: Iterable[str]) -> None:
        """Be one of the gateways, and take these leases where nobody has them."""

    def leave(self) -> None:
        """Be none any more, so that others take the leases at once."""


class SharedGateway(Gateway):
    """A server on PostgreSQL, beside others.

    One thread with a connection of its own raises the gateway's beat and looks at those of others.
    A row whose beat stands still is deleted by whoever notices, and a lease whose gateway has no
    row is free. While the database does not answer nothing changes hands: how long a beat stood
    still is counted only while it could be read.

    Args:
        database: of all gateways.
        directory_id: of its data directory.
        name: for people, such as the host and port.
    """

    shared = True

    def __init__(self, database: Database, directory_id: str, name: str) -> None:
        super().__init__(directory_id)
        self.id = f"gateway-{secrets.token_hex(6)}"
        self.name = name[:200]
        self._database = database
        self._wanted: tuple[str, ...] = ()
        self._held: frozenset[str] = frozenset()
        self._seen: dict[str, tuple[int, float]] = {}
        """Beat of each other gateway, and since when it stands there."""
        self._beaten_s = 0.0
        self._watchers: list[Callable[[], None]] = []
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name="gateway", daemon=True)

    @property
    def others(self) -> bool:
        """Whether other gateways live, as far as it knows."""
        return bool(self._seen)

    def holds(self, lease: str) -> bool:
        """Whether a lease is this gateway's, as far as it knows."""
        return lease in self._held

    def holder(self, lease: str) -> str | None:
        """Return the name of the gateway that has a lease; None: nobody has. Raises NotReady."""
        query = "SELECT g.name FROM leases l JOIN gateways g ON g.id = gateway_id WHERE l.name = :n"
        with self._database.read() as session:
            return session.execute(text(query), {"n": lease}).scalar()

    def watch(self, wake: Callable[[], None]) -> None:
        """Call after whatever other gateways did, and after changes of leases; returns at once."""
        self._watchers.append(wake)

    def announce_change(self, session: Session, device_id: str) -> int | None:
        """Say in a transaction that it changes what a device uses.

        Returns:
            None: the device is this gateway's, and stays so until the transaction ends; else the
            change's number, to be waited for.
        """
        # The lock keeps another from taking the lease: it reads the device after this commit.
        mine = "SELECT 1 FROM leases WHERE name = :lease AND gateway_id = :id FOR SHARE"
        if session.execute(text(mine), {"lease": DEVICES, "id": self.id}).first() is not None:
            return None
        number = session.execute(
            text(
                "INSERT INTO device_changes (device_id, wanted, followed) VALUES (:device, 1, 0) "
                "ON CONFLICT (device_id) DO UPDATE SET wanted = device_changes.wanted + 1 "
                "RETURNING wanted"
            ),
            {"device": device_id},
        ).scalar_one()
        session.execute(text(f"SELECT pg_notify('{_CHANNEL}', '')"))
        return int(number)

    def wait_followed(self, device_id: str, number: int) -> bool:
        """Wait until the gateway with the devices has put a change into effect.

        Returns:
            Whether it has; also False where no gateway has the devices: the next one will.
        """
        query = text(
            "SELECT followed, EXISTS (SELECT 1 FROM leases l JOIN gateways g ON g.id = gateway_id "
            "WHERE l.name = :lease) FROM device_changes WHERE device_id = :device"
        )
        end = time.monotonic() + FOLLOW_S
        while True:
            with self._database.read() as session:
                values = {"device": device_id, "lease": DEVICES}
                followed, held = session.execute(query, values).one()
            if followed >= number:
                return True
            if not held or time.monotonic() > end:
                return False
            self._ended.wait(_POLL_S)

    def changes(self) -> list[tuple[str, int]]:
        """Return devices that others have changed, and the newest change of each."""
        query = text("SELECT device_id, wanted FROM device_changes WHERE wanted > followed")
        with self._database.read() as session:
            return [(str(device), int(wanted)) for device, wanted in session.execute(query)]

    def followed(self, device_id: str, number: int) -> None:
        """Say that the changes of a device up to this one are in effect."""
        with self._database.write() as session:
            session.execute(
                text(
                    "UPDATE device_changes SET followed = :number "
                    "WHERE device_id = :device AND followed < :number"
                ),
                {"device": device_id, "number": number},
            )

    def is_gone(self, owner: InstrumentedAttribute[Any]) -> ColumnElement[bool] | None:
        """Return the condition that a column names no gateway that lives."""
        return owner.not_in(select(GatewayRow.id))

    def join(self, leases: Iterable[str]) -> None:
        """Be one of the gateways, and take these leases where nobody has them."""
        self._wanted = tuple(leases)
        with closing(self._connect()) as connection:
            self._beat(connection)
        self._thread.start()

    def leave(self) -> None:
        """Be none any more, so that others take the leases at once."""
        self._ended.set()
        try:
            with self._database.engine.begin() as connection:
                connection.execute(text(f"SELECT pg_notify('{_CHANNEL}', '')"))
        except SQLAlchemyError:
            pass  # the thread looks by itself
        self._thread.join(3 * BEAT_S)
        try:
            with self._database.engine.begin() as connection:
                connection.execute(text("DELETE FROM gateways WHERE id = :id"), {"id": self.id})
                connection.execute(text(f"SELECT pg_notify('{_CHANNEL}', '')"))
        except SQLAlchemyError as error:
            _log.warning("others see only in %g s that this ends: %s", DEAD_AFTER_S, error)

    def _connect(self) -> Connection[Any]:
        """Return a connection that the pool has no more; each statement is a transaction."""
        pooled = self._database.engine.raw_connection()
        pooled.detach()
        connection: Connection[Any] = pooled.dbapi_connection  # type: ignore[assignment]
        connection.autocommit = True
        return connection

    def _run(self) -> None:
        failing = False
        while not self._ended.is_set():
            try:
                with closing(self._connect()) as connection:
                    connection.execute(f"LISTEN {_CHANNEL}")
                    failing = False
                    while not self._ended.is_set():
                        self._listen(connection)
            except (DriverError, SQLAlchemyError, OSError) as error:
                # Nobody can be seen to live now; those who do not answer have not died of that.
                self._forget_since()
                if not failing:
                    _log.warning("gateways: the database does not answer: %s", error)
                failing = True
                self._ended.wait(BEAT_S)
            except Exception:  # noqa: BLE001 - this thread must not end
                _log.exception("gateways: a beat failed")
                self._ended.wait(BEAT_S)

    def _listen(self, connection: Connection[Any]) -> None:
        """Beat, and wait for what others do until the next beat is due."""
        self._beat(connection)
        while (
            left_s := self._beaten_s + BEAT_S - time.monotonic()
        ) > 0 and not self._ended.is_set():
            for _ in connection.notifies(timeout=left_s, stop_after=1):
                self._wake()

    def _forget_since(self) -> None:
        """Count anew how long each beat stands still."""
        self._seen = dict.fromkeys(self._seen, (-1, 0.0))

    def _wake(self) -> None:
        for watcher in self._watchers:
            watcher()

    def _beat(self, connection: Connection[Any]) -> None:
        """Show that this gateway lives, bury those that do not, and take free leases."""
        now = time.monotonic()
        if now - self._beaten_s > DEAD_AFTER_S:
            self._forget_since()  # it was held up, and others may have beaten meanwhile
        beaten = connection.execute(
            "UPDATE gateways SET beat = beat + 1, heartbeat_at = now() WHERE id = %s", (self.id,)
        )
        if not beaten.rowcount:
            connection.execute(
                "INSERT INTO gateways (id, name, host, process_id, directory_id, beat, started_at, "
                "heartbeat_at) VALUES (%s, %s, %s, %s, %s, 0, now(), now())",
                (self.id, self.name, host_identity(), os.getpid(), self.directory_id),
            )
        buried = self._bury_dead(connection, now)
        leases = dict(
            connection.execute(
                "SELECT l.name, gateway_id FROM leases l JOIN gateways g ON g.id = gateway_id"
            ).fetchall()
        )
        held = {name for name, gateway_id in leases.items() if gateway_id == self.id}
        held |= {
            name for name in self._wanted if name not in leases and self._take(connection, name)
        }
        self._beaten_s = now
        changed = held != self._held
        self._held = frozenset(held)
        if buried or changed:
            self._wake()

    def _bury_dead(self, connection: Connection[Any], now: float) -> bool:
        """Delete the rows of gateways that do not live; return whether there was one."""
        rows = connection.execute(
            "SELECT id, name, host, process_id, beat FROM gateways WHERE id != %s", (self.id,)
        ).fetchall()
        dead = []
        for gateway_id, name, host, process_id, beat in rows:
            seen = self._seen.get(gateway_id)
            if seen is None or seen[0] != beat:
                self._seen[gateway_id] = beat, now
            still = seen is not None and seen[0] == beat and now - seen[1] > DEAD_AFTER_S
            if still or (host == host_identity() and not _runs(process_id)):
                dead.append((gateway_id, name, beat))
        buried = False
        for gateway_id, name, beat in dead:
            deleted = connection.execute(
                "DELETE FROM gateways WHERE id = %s AND beat = %s", (gateway_id, beat)
            )
            if deleted.rowcount:
                _log.warning("gateway %s (%s) does not live any more", name, gateway_id)
                connection.execute(f"NOTIFY {_CHANNEL}")
                buried = True
        for gateway_id in self._seen.keys() - {row[0] for row in rows}:
            del self._seen[gateway_id]
        return buried

    def _take(self, connection: Connection[Any], lease: str) -> bool:
        """Take a lease unless a gateway that lives has it."""
        with connection.transaction():
            # One after the other, or the second would not see that the first has joined.
            connection.execute("SELECT pg_advisory_xact_lock(%s)", (_LEASES_LOCK,))
            taken = connection.execute(
                "INSERT INTO leases (name, gateway_id) VALUES (%s, %s) ON CONFLICT (name) "
                "DO UPDATE SET gateway_id = EXCLUDED.gateway_id "
                "WHERE leases.gateway_id NOT IN (SELECT id FROM gateways)",
                (lease, self.id),
            )
        if taken.rowcount:
            _log.info("this gateway has the lease %s", lease)
        return bool(taken.rowcount)


def directory_identity(folder: Path) -> str:
    """Return the id of a data directory, which whoever shares it finds there; made at the first.

    Raises:
        OSError: it cannot be read or written to.
    """
    file = folder / "directory-id"
    with suppress(FileExistsError), file.open("x") as made:
        made.write(f"directory-{secrets.token_hex(6)}\n")
    while not (found := file.read_text().strip()):
        time.sleep(_POLL_S)  # another has made it, and writes
    return found


def host_identity() -> str:
    """Return what names this machine's processes: the same number elsewhere is another process."""
    try:
        boot = Path("/proc/sys/kernel/random/boot_id").read_text().strip()
        return f"{boot}/{Path('/proc/self/ns/pid').readlink()}"
    except OSError:
        return socket.gethostname()


def _runs(process_id: int) -> bool:
    try:
        os.kill(process_id, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True
