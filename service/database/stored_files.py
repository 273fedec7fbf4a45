"""StoredFiles: what lies in the data directories of all gateways, listed in the database."""

import logging
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from threading import Lock
from typing import Any, Literal

from sqlalchemy import delete, select
from sqlalchemy.dialects.postgresql import insert
from sqlalchemy.orm import Session

from service.database.engine import Database
from service.database.gateway import Gateway
from service.database.models import GatewayRow, StoredFileRow
from service.problems.errors import FileElsewhere, NotReady

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class StoredFile:
    """A file that this gateway has not, or that another one writes.

    Args:
        name: of the file.
        changed_ns: when it was changed.
        gateway: the name of a gateway that has it.
        here: whether it lies in this gateway's data directory, which the other shares.
        document: what clients read of it.
    """

    name: str
    changed_ns: int
    gateway: str
    here: bool
    document: dict[str, Any]

    def elsewhere(self, kind: str) -> FileElsewhere:
        """Return the error that only the other gateway gives it."""
        return FileElsewhere(
            f'gateway "{self.gateway}" has {kind} "{self.name}", and not this one: ask that one',
            **{f"{kind}_id": self.name},
            gateway=self.gateway,
        )


class StoredFiles:
    """One kind of files of all gateways that live; a server without others lists nothing.

    Args:
        database: of all gateways.
        gateway: this server.
        kind: of the files.
    """

    def __init__(
        self, database: Database, gateway: Gateway, kind: Literal["recording", "export"]
    ) -> None:
        self._database = database
        self._gateway = gateway
        self._kind = kind
        self._published: dict[str, int] | None = None
        self._ended: set[str] = set()
        """Files whose end could not be listed yet."""
        self._listing = Lock()
        """Held while files are listed: what begins or ends meanwhile is listed behind that."""

    def others(self) -> dict[str, StoredFile]:
        """Return what other gateways have or write; nothing while the database does not answer."""
        if not self._gateway.others:
            return {}
        try:
            with self._database.read() as session:
                return self._others(session)
        except NotReady:
            return {}  # logged there; what is here can be listed

    def other(self, name: str) -> StoredFile | None:
        """Return a file that another gateway has or writes; None: none does."""
        return self.others().get(name)

    def begin(self, name: str, document: Mapping[str, Any], changed_ns: int) -> StoredFile | None:
        """List a file that this gateway begins to write; return the one that has its name, if any.

        Raises:
            NotReady: the database does not answer.
        """
        if not self._gateway.shared:
            return None
        with self._listing, self._database.write() as session:
            taken = self._others(session).get(name)
            if taken is None:
                self._put(session, name, document, changed_ns, self._gateway.id)
        return taken

    def end(self, name: str, document: Mapping[str, Any], changed_ns: int) -> None:
        """List a file that this gateway has written to its end."""
        if not self._gateway.shared:
            return
        try:
            with self._listing, self._database.write() as session:
                self._put(session, name, document, changed_ns, None)
        except NotReady:
            self._ended.add(name)  # logged there

    def discard(self, name: str) -> None:
        """List a file no more that this gateway has begun, of which nothing came."""
        if not self._gateway.shared:
            return
        row = delete(StoredFileRow).where(
            StoredFileRow.directory_id == self._gateway.directory_id,
            StoredFileRow.kind == self._kind,
            StoredFileRow.name == name,
            StoredFileRow.gateway_id == self._gateway.id,
        )
        with suppress(NotReady), self._listing, self._database.write() as session:
            session.execute(row)

    def publish(
        self,
        files: Mapping[str, tuple[int, dict[str, Any]]],
        written_now: Callable[[], frozenset[str]],
    ) -> None:
        """List what this gateway has, as it is now.

        Args:
            files: by name when they were changed, and what clients read of them.
            written_now: returns those that this gateway writes; of a shared directory nothing else
                is listed unless this gateway tidies it.
        """
        if not self._gateway.others:
            self._published = None
            return
        with self._listing:
            self._publish(files, written_now())

    def _publish(
        self, files: Mapping[str, tuple[int, dict[str, Any]]], written: frozenset[str]
    ) -> None:
        tidies = self._gateway.holds(self._gateway.files_lease)
        ended = frozenset(self._ended)
        listed = written | ended
        mine = {name: file for name, file in files.items() if tidies or name in listed}
        before = self._published
        with self._database.write() as session:
            elsewhere = self._others(session)
            for name, (changed_ns, document) in mine.items():
                known = None if before is None else before.get(name)
                if name not in elsewhere and (known != changed_ns or name in listed):
                    writer = self._gateway.id if name in written else None
                    self._put(session, name, document, changed_ns, writer)
            if tidies:
                rows = delete(StoredFileRow).where(
                    StoredFileRow.directory_id == self._gateway.directory_id,
                    StoredFileRow.kind == self._kind,
                    StoredFileRow.name.not_in([*files, *written, *elsewhere]),
                )
                session.execute(rows)
        self._published = {name: file[0] for name, file in mine.items()}
        self._ended -= ended

    def _others(self, session: Session) -> dict[str, StoredFile]:
        directory = self._gateway.directory_id
        living = select(GatewayRow.directory_id).where(GatewayRow.directory_id != directory)
        writers = select(GatewayRow.id).where(GatewayRow.id != self._gateway.id)
        rows = session.scalars(
            select(StoredFileRow)
            .where(
                StoredFileRow.kind == self._kind,
                StoredFileRow.directory_id.in_(living) | StoredFileRow.gateway_id.in_(writers),
            )
            .order_by(StoredFileRow.directory_id == directory, StoredFileRow.directory_id)
        )
        return {
            row.name: StoredFile(
                row.name,
                row.changed_ns,
                row.gateway_name,
                row.directory_id == directory,
                row.document,
            )
            for row in rows
        }

    def _put(
        self,
        session: Session,
        name: str,
        document: Mapping[str, Any],
        changed_ns: int,
        writer: str | None,
    ) -> None:
        values = {
            "changed_ns": changed_ns,
            "document": dict(document),
            "gateway_id": writer,
            "gateway_name": self._gateway.name,
        }
        key = {"directory_id": self._gateway.directory_id, "kind": self._kind, "name": name}
        row = insert(StoredFileRow).values(**key, **values)
        session.execute(row.on_conflict_do_update(index_elements=list(key), set_=values))
