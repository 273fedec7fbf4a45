"""REST resource /api/v1/settings: how this server is set."""

import re

from pydantic import Field, JsonValue
from sqlalchemy.engine import make_url

from service.api.base_models import ResponseModel
from service.api.inputs import SettingsDep
from service.api.openapi import ResourceRouter
from service.api.paging import Page, PagingDep, page_of_sequence
from service.settings import Settings

router = ResourceRouter("/api/v1/settings", "server")


class Setting(ResponseModel):
    """A setting of the server, as it is in force."""

    name: str = Field(description="In the file of settings; as a variable LUMILINE_ and this.")
    value: JsonValue = Field(description="What is in force; passwords in URLs are hidden.")
    is_default: bool = Field(description="Whether nobody set it to something else.")
    description: str = Field(description="What it does.")


@router.operation("GET", "list-settings", "The settings in force")
def list_settings(settings: SettingsDep, paging: PagingDep) -> Page[Setting]:
    """By name. They are read when the server starts."""
    names = list(Settings.model_fields)
    return page_of_sequence(
        names, paging, lambda name: _setting(settings, name), lambda one: (one,)
    )


def _setting(settings: Settings, name: str) -> Setting:
    field = Settings.model_fields[name]
    value = settings.model_dump(mode="json", include={name})[name]
    default = field.get_default(call_default_factory=True)
    return Setting(
        name=name,
        value=_without_password(name, value),
        is_default=getattr(settings, name) == default,
        description=" ".join((field.description or "").split()),
    )


def _without_password(name: str, value: JsonValue) -> JsonValue:
    if not isinstance(value, str) or name not in ("database_url", "bus_url"):
        return value
    if name == "database_url":
        return make_url(value).render_as_string(hide_password=True)
    return re.sub(r"//[^@/,]*@", "//***@", value)
