"""REST resources /api/v1/settings and /api/v1/backups: how this server is set, and what is safe."""

from datetime import datetime
from pathlib import Path

from pydantic import Field, JsonValue
from sqlalchemy.engine import make_url

from service.api.base_models import Moment, ResponseModel
from service.api.inputs import SettingsDep
from service.api.openapi import ResourceRouter
from service.api.paging import Page, PagingDep, page_of_sequence
from service.backup.files import DATABASE, backup_time, backups_beside_last
from service.settings import Settings

settings_router = ResourceRouter("/api/v1/settings", "server")
backups_router = ResourceRouter("/api/v1/backups", "server")


class Setting(ResponseModel):
    """A setting of the server, as it is in force."""

    name: str = Field(description="In the file of settings; as a variable LUMILINE_ and this.")
    value: JsonValue = Field(description="What is in force; a database's password is hidden.")
    is_default: bool = Field(description="Whether nobody set it to something else.")
    description: str = Field(description="What it does.")


class Backup(ResponseModel):
    """A backup of database, recordings and profiles."""

    id: str = Field(description="The name of its folder.")
    created_at: Moment
    path: str = Field(description="Its folder on the server, as `lumiline restore` takes it.")
    database_bytes: int = Field(description="Size of the database in it.")


@settings_router.operation("GET", "list-settings", "The settings in force")
def list_settings(settings: SettingsDep, paging: PagingDep) -> Page[Setting]:
    """By name. They are read when the server starts."""
    names = list(Settings.model_fields)
    return page_of_sequence(
        names, paging, lambda name: _setting(settings, name), lambda one: (one,)
    )


@backups_router.operation("GET", "list-backups", "Backups of this server")
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
        lambda one: (-moments[one].timestamp(),),
    )


def _setting(settings: Settings, name: str) -> Setting:
    field = Settings.model_fields[name]
    value = settings.model_dump(mode="json", include={name})[name]
    default = field.get_default(call_default_factory=True)
    return Setting(
        name=name,
        value=_without_password(value) if name == "database_url" else value,
        is_default=getattr(settings, name) == default,
        description=" ".join((field.description or "").split()),
    )


def _without_password(url: str | None) -> str | None:
    return None if url is None else make_url(url).render_as_string(hide_password=True)


def _backup(folder: Path, created_at: datetime) -> Backup | None:
    try:
        size = (folder / DATABASE).stat().st_size
    except OSError:
        return None  # deleted meanwhile
    return Backup(id=folder.name, created_at=created_at, path=str(folder), database_bytes=size)
