"""REST resource /api/v1/backups: backups of this server."""

from datetime import datetime
from pathlib import Path

from pydantic import Field

from service.api.base_models import Moment, ResponseModel
from service.api.inputs import SettingsDep
from service.api.openapi import ResourceRouter
from service.api.paging import Page, PagingDep, page_of_sequence
from service.backup.files import DATABASE, backup_time, backups_beside_last

router = ResourceRouter("/api/v1/backups", "server")


class Backup(ResponseModel):
    """A backup of database, recordings and profiles."""

    id: str = Field(description="The name of its folder.")
    created_at: Moment
    path: str = Field(description="Its folder on the server, as `lumiline restore` takes it.")
    database_bytes: int = Field(description="Size of the database in it.")


@router.operation("GET", "list-backups", "Backups of this server")
def list_backups(settings: SettingsDep, paging: PagingDep) -> Page[Backup]:
    """Newest first: those in the folder of the last one, which `lumiline backup --files` wrote.

    Empty where there never was one, or where the server may not read it.
    """
    found = backups_beside_last(settings.data_dir)
    moments = {one: backup_time(one) for one in found}
    return page_of_sequence(
        found,
        paging,
        lambda one: _backup(one, moments[one]),
        lambda one: (-int(moments[one].timestamp()),),
    )


def _backup(folder: Path, created_at: datetime) -> Backup | None:
    try:
        size = (folder / DATABASE).stat().st_size
    except OSError:
        return None  # deleted meanwhile
    return Backup(id=folder.name, created_at=created_at, path=str(folder), database_bytes=size)
