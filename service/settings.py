"""Settings of the service: from arguments, LUMILINE_... variables, then a TOML file."""

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from pydantic import Field
from pydantic_settings import (
    BaseSettings,
    PydanticBaseSettingsSource,
    SettingsConfigDict,
    TomlConfigSettingsSource,
)


def default_data_dir() -> Path:
    """Return ``$XDG_DATA_HOME/lumiline``, by default ``~/.local/share/lumiline``."""
    home = os.environ.get("XDG_DATA_HOME") or str(Path.home() / ".local" / "share")
    return Path(home) / "lumiline"


def configuration_file() -> Path:
    """Return the file named by LUMILINE_CONFIG, else ``lumiline.toml`` where we were started."""
    return Path(os.environ.get("LUMILINE_CONFIG") or "lumiline.toml")


@dataclass(frozen=True)
class DataFolders:
    """Folders of the data directory.

    Args:
        recordings: the only folder from which recordings are replayed.
        profiles: device profiles of one's own.
    """

    recordings: Path
    profiles: Path


class Settings(BaseSettings):
    """What an administrator may set; every value has a default that works as it stands."""

    # Errors without the values: one may be the database's URL, under whatever misspelt name.
    model_config = SettingsConfigDict(
        env_prefix="LUMILINE_", extra="forbid", frozen=True, hide_input_in_errors=True
    )

    data_dir: Path = Field(default_factory=default_data_dir)
    """Where the SQLite file and the folder ``recordings`` lie."""
    database_url: str | None = None
    """SQLAlchemy URL, for PostgreSQL ``postgresql+psycopg://...``; None: SQLite in data_dir."""
    host: str = "127.0.0.1"
    port: int = Field(default=8000, ge=0, le=65535)
    log_level: Literal["critical", "error", "warning", "info", "debug"] = "info"
    device: str | None = None
    """A device profile to start as a device: the name of a built-in one, or the path of a file."""
    compute_device: str | None = None
    """Where the live pipeline computes: ``cpu``, ``cuda:0``, ...; None: the compute's choice."""
    stream_queue_messages: int = Field(default=2000, ge=1)
    """Messages that wait for one stream client before the oldest are dropped (and counted)."""
    runs_at_once: int = Field(default=1, ge=1, le=64)
    """Calibrations and mappings computed at the same time, each on one core."""
    runs_waiting: int = Field(default=100, ge=1)
    """Runs that may wait for their turn before another is refused."""
    body_limit_bytes: int = Field(default=8 * 1024 * 1024, ge=1024)
    """Largest request body [bytes]."""
    table_limit_bytes: int = Field(default=64 * 1024 * 1024, ge=1024)
    """Largest file of a correction table that is uploaded [bytes]."""

    @property
    def effective_database_url(self) -> str:
        """The database's URL, the default SQLite file included."""
        return self.database_url or f"sqlite:///{self.data_dir / 'lumiline.sqlite3'}"

    @property
    def folders(self) -> DataFolders:
        """The folders of the data directory."""
        return DataFolders(self.data_dir / "recordings", self.data_dir / "profiles")

    @classmethod
    def settings_customise_sources(
        cls,
        settings_cls: type[BaseSettings],
        init_settings: PydanticBaseSettingsSource,
        env_settings: PydanticBaseSettingsSource,
        dotenv_settings: PydanticBaseSettingsSource,  # noqa: ARG003 - pydantic passes it by name
        file_secret_settings: PydanticBaseSettingsSource,  # noqa: ARG003
    ) -> tuple[PydanticBaseSettingsSource, ...]:
        """Order of the sources: arguments, environment, TOML file."""
        file = configuration_file()
        if not file.is_file():
            if os.environ.get("LUMILINE_CONFIG"):
                raise FileNotFoundError(f"LUMILINE_CONFIG names {file}, which is not a file")
            return init_settings, env_settings
        return init_settings, env_settings, TomlConfigSettingsSource(settings_cls, toml_file=file)
