"""ExportRepository: the folder of files that export runs have made."""

import re
import shutil
from collections.abc import Callable, Collection
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Final

from compute.errors import InvalidParameter
from service.api.base_models import SLUG_PATTERN
from service.api.exports.schema import FORMATS, ExportFile, Format
from service.problems.errors import (
    ExportExists,
    FileElsewhere,
    InsufficientStorage,
    UnknownExport,
)

if TYPE_CHECKING:
    from service.database.stored_files import StoredFiles

_UNFINISHED: Final = ".unfinished"
MEDIA_TYPES: Final[dict[str, str]] = {
    "c3d": "application/octet-stream",
    "trc": "text/tab-separated-values",
    "csv": "text/csv",
    "parquet": "application/vnd.apache.parquet",
    "igs.mha": "application/octet-stream",
}


class ExportRepository:
    """Files of a folder, each found by its id whatever its format; used from any thread.

    Args:
        folder: the data directory's folder ``exports``; made when it is first written to.
        free_bytes: what is left free on its disk.
        stored: exports of other gateways on the same database; None: there are none.
    """

    def __init__(
        self, folder: Path, free_bytes: int = 0, stored: "StoredFiles | None" = None
    ) -> None:
        self.folder = folder
        self._stored = stored
        self.free_bytes = free_bytes

    def all(self) -> list[ExportFile]:
        """Return all files, also those that other gateways have."""
        found = self._own()
        here = {one.id for one in found}
        others = {} if self._stored is None else self._stored.others()
        return found + [
            ExportFile.model_validate(one.document | {"gateway": one.gateway})
            for name, one in others.items()
            if name not in here
        ]

    def announce_files(self) -> None:
        """List the files of this server for other gateways."""
        if self._stored is not None:
            files = {
                one.id: (round(one.created_at.timestamp() * 1e9), one.model_dump(mode="json"))
                for one in self._own()
            }
            self._stored.publish(files, frozenset)

    def document(self, export_id: str) -> ExportFile:
        """Return an export's document, also of another gateway's; raises UnknownExport."""
        try:
            return self.find(export_id)[1]
        except FileElsewhere:
            found = {one.id: one for one in self.all()}
            if export_id in found:
                return found[export_id]
            raise

    def _own(self) -> list[ExportFile]:
        found = []
        for path in self.folder.glob("*.*"):
            name = _split_name(path)
            if name is None:
                continue
            try:
                found.append(_document(path, *name))
            except OSError:
                continue  # deleted meanwhile
        return found

    def find(self, export_id: str) -> tuple[Path, ExportFile]:
        """Return an export's path and document.

        Raises:
            UnknownExport.
            FileElsewhere: another gateway has it.
        """
        for kind in FORMATS:
            path = self._path(export_id, kind)
            try:
                return path, _document(path, export_id, kind)
            except OSError:
                continue
        other = None if self._stored is None else self._stored.other(export_id)
        if other is not None:
            raise other.elsewhere("export")
        raise UnknownExport(
            f'there is no export "{export_id}"; GET /api/v1/exports lists them', export_id=export_id
        )

    def check_unused(self, export_id: str | None) -> None:
        """Raise ExportExists when there is a file of this id; None is free."""
        if export_id is None:
            return
        try:
            self.find(export_id)
        except UnknownExport:
            return
        except FileElsewhere:
            pass
        raise ExportExists(
            f'export "{export_id}" exists already; choose another result_id, leave it out, or '
            "delete that one",
            export_id=export_id,
        )

    def check_space(self) -> None:
        """Raise InsufficientStorage when less than is to stay free is free."""
        self.folder.mkdir(parents=True, exist_ok=True)
        check_space(self.folder, self.free_bytes)

    def delete(self, export_id: str) -> None:
        """Delete a file; raises UnknownExport."""
        path, _ = self.find(export_id)
        path.unlink(missing_ok=True)

    def partial_path(self, run_id: str, kind: Format) -> Path:
        """Return where a run is to write; its folder is there."""
        folder = self.folder / _UNFINISHED
        folder.mkdir(parents=True, exist_ok=True)
        return folder / f"{run_id}.{kind}"

    def publish(self, run_id: str, kind: Format, export_id: str) -> None:
        """Give what a run has written its name; once more changes nothing.

        Raises:
            ExportExists: there is a file of the name meanwhile.
        """
        source = self.partial_path(run_id, kind)
        if not source.exists() and self._path(export_id, kind).exists():
            return  # kept, and asked again because the database did not answer
        self.check_unused(export_id)
        source.replace(self._path(export_id, kind))

    def discard(self, run_id: str) -> None:
        """Delete what a run has written and not kept."""
        for kind in FORMATS:
            (self.folder / _UNFINISHED / f"{run_id}.{kind}").unlink(missing_ok=True)

    def sweep(self, running: Callable[[], Collection[str]]) -> None:
        """Delete what runs have left whose server was killed.

        Args:
            running: returns the ids of the runs that are being computed; asked when it is known
                what lies there, so that no run which begins meanwhile loses its file.
        """
        left = list((self.folder / _UNFINISHED).glob("*.*"))
        computed = running() if left else ()
        for path in left:
            if path.name.partition(".")[0] not in computed:
                path.unlink(missing_ok=True)

    def _path(self, export_id: str, kind: Format) -> Path:
        if re.fullmatch(SLUG_PATTERN, export_id) is None:
            raise InvalidParameter(f'"{export_id}" is not an id of an export', export_id=export_id)
        return self.folder / f"{export_id}.{kind}"


def check_space(folder: Path, free_bytes: int) -> None:
    """Raise InsufficientStorage when less than this is free on a folder's disk."""
    free = shutil.disk_usage(folder).free
    if free < free_bytes:
        raise InsufficientStorage(
            f"{free} bytes are free on the disk of the exports; {free_bytes} have to stay free: "
            "delete exports or recordings",
            free_bytes=free,
        )


def _split_name(path: Path) -> tuple[str, Format] | None:
    """Return id and format of a file's name; None: it is none of ours."""
    export_id, _, suffix = path.name.partition(".")
    kind = next((kind for kind in FORMATS if kind == suffix), None)
    if kind is None or re.fullmatch(SLUG_PATTERN, export_id) is None:
        return None
    return export_id, kind


def _document(path: Path, export_id: str, kind: Format) -> ExportFile:
    status = path.stat()
    return ExportFile(
        id=export_id,
        format=kind,
        file_name=path.name,
        media_type=MEDIA_TYPES[kind],
        size_bytes=status.st_size,
        created_at=datetime.fromtimestamp(status.st_mtime, UTC),
    )
