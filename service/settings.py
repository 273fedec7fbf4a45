"""Settings of the service: from arguments, LUMILINE_... variables, then a TOML file."""

import difflib
import os
import sys
from dataclasses import dataclass
from importlib.util import find_spec
from ipaddress import ip_network
from pathlib import Path
from typing import Annotated, Final, Literal
from urllib.parse import urlsplit

from pydantic import Field, field_validator, model_validator
from pydantic_settings import (
    BaseSettings,
    PydanticBaseSettingsSource,
    SettingsConfigDict,
    TomlConfigSettingsSource,
)

from service.allow_list import AllowList

_STATION_PATTERN: Final = r"^[a-z0-9]([a-z0-9-]{0,61}[a-z0-9])?$"
_OF_CLIENTS: Final = frozenset({"LUMILINE_URL", "LUMILINE_KEY"})


def default_data_dir() -> Path:
    """Return ``$XDG_DATA_HOME/lumiline``, by default ``~/.local/share/lumiline``."""
    home = os.environ.get("XDG_DATA_HOME") or str(Path.home() / ".local" / "share")
    return Path(home) / "lumiline"


def default_station() -> Literal["process", "thread"]:
    """Return "process" on Linux, which has what its bus and its start need."""
    return "process" if sys.platform == "linux" else "thread"


def configuration_file() -> Path:
    """Return the file named by LUMILINE_CONFIG, else ``lumiline.toml`` where we were started."""
    return Path(os.environ.get("LUMILINE_CONFIG") or "lumiline.toml")


@dataclass(frozen=True)
class DataFolders:
    """Folders of the data directory.

    Args:
        recordings: the only folder from which recordings are replayed.
        profiles: device profiles of one's own.
        exports: files that export runs have made.
    """

    recordings: Path
    profiles: Path
    exports: Path


class Settings(BaseSettings):
    """Settings of the server; every value has a default that works as it stands."""

    # Errors without the values: one may be the database's URL, under whatever misspelt name.
    model_config = SettingsConfigDict(
        env_prefix="LUMILINE_",
        extra="forbid",
        frozen=True,
        hide_input_in_errors=True,
        use_attribute_docstrings=True,
    )

    data_dir: Path = Field(default_factory=default_data_dir)
    """Where the SQLite file and the folder ``recordings`` lie."""
    database_url: str | None = None
    """SQLAlchemy URL, for PostgreSQL ``postgresql+psycopg://...``; None: SQLite in data_dir."""
    host: str = "127.0.0.1"
    """Address that it listens on."""
    port: int = Field(default=8000, ge=0, le=65535)
    """Port that it listens on; 0: a free one."""
    log_level: Literal["critical", "error", "warning", "info", "debug"] = "info"
    """Log lines of this level and above are written."""
    log_format: Literal["text", "json"] = "text"
    """Log lines as readable text, or one JSON object each."""
    profile: str | None = None
    """A device profile to start as a device: the name of a built-in one, or the path of a file."""
    compute_device: str | None = None
    """Where the live pipeline computes: ``cpu``, ``cuda:0``, ...; None: the compute's choice."""
    station: Literal["process", "thread", "none"] = Field(default_factory=default_station)
    """Where devices, their frames and beam holds are: in a process of their own, which nothing
    that clients ask for holds up, or in threads of the server; none: only at stations on other
    machines, for which there has to be a ``bus_url``."""
    station_priority: int | None = Field(default=None, ge=1, le=99)
    """Priority of real time of that process, above all that have none; None: as all others. It
    needs the right to it."""
    station_cores: tuple[Annotated[int, Field(ge=0)], ...] = ()
    """Numbers of the cores that process may use; none: all."""
    station_name: str | None = Field(default=None, pattern=_STATION_PATTERN)
    """What `lumiline station` is called: devices that name it are its own."""
    bus_url: str | None = None
    """The NATS server, or several with commas between, by which servers reach the stations of other
    machines: ``nats://host:4222``, or ``tls://...``; None: there are none."""
    bus_nkey_seed: Path | None = None
    """File with the seed of the NKey by which NATS knows this program."""
    bus_credentials: Path | None = None
    """File with a JWT and its seed (``.creds``), in place of an NKey."""
    bus_token_file: Path | None = None
    """File with a token, in place of an NKey."""
    bus_ca: Path | None = None
    """File with the certificate of who signed that of NATS; with it nothing goes without TLS."""
    bus_delay_s: float = Field(default=0.01, ge=0.0, le=1.0, allow_inf_nan=False)
    """How long a station keeps a frame for others to go with it over the bus [s]; poses and beam
    holds wait for nothing."""
    gateway_devices: bool = True
    """Whether this server may have the devices where several share a PostgreSQL database; one of
    them has, and another takes them when it ends. Without: what is attached to another machine."""
    stream_kept_messages: int = Field(default=10_000, ge=1)
    """Messages of each device that are kept for stream clients which are behind or come back."""
    stream_lag_s: float = Field(default=1.0, ge=0.0, allow_inf_nan=False)
    """How far a live client may fall behind before it goes on with the newest [s]."""
    recording_free_bytes: int = Field(default=2 * 1024**3, ge=0)
    """What recordings, and exports of them, leave free on their disk [bytes]."""
    recording_flush_s: float = Field(default=1.0, ge=0.01, le=60.0)
    """How often what is recorded is brought to the file, to be read and safe from a crash [s]."""
    recording_max_age_days: float | None = Field(default=None, gt=0.0, le=36_525.0)
    """Recordings that were last changed longer ago are deleted [days]; None: none are."""
    recording_max_total_bytes: int | None = Field(default=None, ge=1024**2)
    """Above it the oldest recordings are deleted [bytes]; None: none are."""
    runs_at_once: int = Field(default=1, ge=1, le=64)
    """Calibrations and mappings computed at the same time, each on one core."""
    runs_waiting: int = Field(default=100, ge=1)
    """Runs that may wait for their turn before another is refused."""
    body_limit_bytes: int = Field(default=8 * 1024 * 1024, ge=1024)
    """Largest request body [bytes]."""
    table_limit_bytes: int = Field(default=64 * 1024 * 1024, ge=1024)
    """Largest file of a correction table that is uploaded [bytes]."""
    surface_points: int = Field(default=2000, ge=12)
    """Most measured points of a registration by a surface: some milliseconds each."""
    surface_size: int = Field(default=100_000, ge=12)
    """Most vertices, and most triangles, or points of such a surface."""
    body_seconds: float = Field(default=60.0, gt=0.0, le=3600.0)
    """Within which a request's body has to arrive [s]."""
    authentication: Literal["loopback-open", "required"] = "loopback-open"
    """``required``: every client needs a key; else none on this machine does, while only it can
    reach the server."""
    trusted_proxies: tuple[str, ...] = ()
    """Addresses or networks of proxies whose X-Forwarded-For is believed; with any, every client
    needs a key."""
    failed_logins_per_minute: int = Field(default=30, ge=1, le=10_000)
    """Failed log-ins of one address before it has to wait."""
    connections: int = Field(default=512, ge=1)
    """Connections and requests at the same time; more are answered with 503."""
    streams_per_key: int = Field(default=100, ge=1)
    """Open streams of one key, or of all local programs."""
    oidc_issuer: str | None = None
    """Identity provider whose tokens are taken beside keys; its URL as in the tokens."""
    oidc_audience: str | None = None
    """The audience that its tokens must name; required with ``oidc_issuer``."""
    oidc_jwks_url: str | None = None
    """Where the provider's keys are; None: as its ``.well-known/openid-configuration`` says."""
    oidc_scope_claim: str = Field(default="scope", min_length=1)
    """The tokens' member with the scopes: a text with spaces, or a list."""

    openigtlink_port: int | None = Field(default=None, ge=0, le=65535)
    """Port of the OpenIGTLink server; 18944 is the usual one; None: there is none."""
    openigtlink_host: str = "127.0.0.1"
    """Address that it listens on; another than loopback needs ``openigtlink_allow``."""
    openigtlink_allow: tuple[str, ...] = ()
    """Addresses or networks of its clients, besides this machine's: the protocol has no keys."""
    openigtlink_device: str | None = None
    """The device whose tools it sends; None: the first that has any."""
    openigtlink_rate_hz: float = Field(default=250.0, gt=0.0, le=10_000.0)
    """Most frames that one client gets a second, the newest each time."""
    openigtlink_clients: int = Field(default=16, ge=1, le=1000)
    """Most clients at the same time."""
    openigtlink_stall_s: float = Field(default=10.0, gt=0.0, le=3600.0)
    """How long a client may read nothing before it is disconnected [s]."""
    openigtlink_message_s: float = Field(default=30.0, gt=0.0, le=3600.0)
    """Within which a message of a client has to arrive [s]."""
    openigtlink_send_invalid: bool = False
    """Send poses that are not OK, too, marked so, to clients of header version 2."""
    openigtlink_changes: bool = False
    """Let clients begin and end recordings, and set transforms; nobody knows who they are."""

    ndi_port: int | None = Field(default=None, ge=0, le=65535)
    """Port of the answerer for NDI clients; 8765 is the usual one; None: there is none."""
    ndi_host: str = "127.0.0.1"
    """Address that it listens on; another than loopback needs ``ndi_allow``."""
    ndi_allow: tuple[str, ...] = ()
    """Addresses or networks of its clients, besides this machine's: the protocol has no keys."""
    ndi_device: str | None = None
    """The device whose tools it reports; None: the only one that has any."""
    ndi_clients: int = Field(default=16, ge=1, le=1000)
    """Most clients at the same time."""
    ndi_model: str = Field(default="Lumiline Polaris-compatible", pattern=r"^[ -~]{1,40}$")
    """What clients are told that they speak to; some look for a word in it."""
    ndi_part_numbers: dict[str, str] = Field(default_factory=dict)
    """Ids of tools by what the tool definitions that clients upload call them."""

    @field_validator("station")
    @classmethod
    def _can_be_started(cls, station: str) -> str:
        if station == "process" and sys.platform != "linux":
            raise ValueError(
                "a station's process needs Linux; leave the setting out, or give 'thread'"
            )
        return station

    @field_validator("bus_url")
    @classmethod
    def _brokers(cls, urls: str | None) -> str | None:
        for url in (urls or "nats://none").split(","):
            parts = urlsplit(url.strip())
            if parts.scheme not in ("nats", "tls") or not parts.hostname:
                raise ValueError("must be such as nats://broker:4222 or tls://broker:4222")
        return urls

    @field_validator("trusted_proxies", "openigtlink_allow", "ndi_allow")
    @classmethod
    def _addresses(cls, addresses: tuple[str, ...]) -> tuple[str, ...]:
        for one in addresses:
            try:
                network = ip_network(one)
            except ValueError as error:
                raise ValueError(
                    f"{one!r} is no IP address or network ({error}); give such as 10.0.0.5 or "
                    "10.0.0.0/24"
                ) from None
            if network.prefixlen == 0:
                raise ValueError(f"{one!r} is every address; name those that are meant")
        return addresses

    @field_validator("oidc_issuer", "oidc_jwks_url")
    @classmethod
    def _secure(cls, url: str | None) -> str | None:
        parts = urlsplit(url or "https://none")
        if parts.scheme == "https" and parts.hostname:
            return url
        if parts.scheme == "http" and parts.hostname in ("127.0.0.1", "localhost", "::1"):
            return url
        raise ValueError("must be an https:// URL (http:// only on this machine)")

    @model_validator(mode="after")
    def _complete(self) -> "Settings":
        if self.oidc_issuer is not None and not self.oidc_audience:
            raise ValueError("oidc_issuer needs oidc_audience: tokens for others are not ours")
        if self.station == "none" and self.bus_url is None:
            raise ValueError("station none needs a bus_url: all devices are at stations then")
        ways = (self.bus_nkey_seed, self.bus_credentials, self.bus_token_file)
        if sum(way is not None for way in ways) > 1:
            raise ValueError("give one of bus_nkey_seed, bus_credentials and bus_token_file")
        if self.bus_url is not None and find_spec("nats") is None:
            raise ValueError("bus_url needs a library: pip install 'lumiline[bus]'")
        if self.bus_url is None and (self.bus_ca, *ways) != (None,) * 4:
            raise ValueError("settings of the bus need a bus_url")
        _check_reach("openigtlink", self.openigtlink_host, self.openigtlink_allow)
        _check_reach("ndi", self.ndi_host, self.ndi_allow)
        return self

    @property
    def effective_database_url(self) -> str:
        """The database's URL, the default SQLite file included."""
        return self.database_url or f"sqlite:///{self.data_dir / 'lumiline.sqlite3'}"

    @property
    def folders(self) -> DataFolders:
        """The folders of the data directory."""
        names = ("recordings", "profiles", "exports")
        return DataFolders(*(self.data_dir / name for name in names))

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
        _check_environment({f"LUMILINE_{name.upper()}" for name in settings_cls.model_fields})
        file = configuration_file()
        if not file.is_file():
            if os.environ.get("LUMILINE_CONFIG"):
                raise FileNotFoundError(f"LUMILINE_CONFIG names {file}, which is not a file")
            return init_settings, env_settings
        return init_settings, env_settings, TomlConfigSettingsSource(settings_cls, toml_file=file)


def _check_reach(protocol: str, host: str, allow: tuple[str, ...]) -> None:
    """Refuse a port that others reach, of a protocol without keys, unless it says which others."""
    if not (host == "localhost" or AllowList().permits(host) or allow):
        raise ValueError(
            f"{protocol}_host {host} is reached from other machines, and the protocol has no keys: "
            f"name the clients' addresses in {protocol}_allow"
        )


def _check_environment(settings: set[str]) -> None:
    """Refuse variables that look like settings and are none: one may be misspelt.

    Those of tests are left alone, and those by which commands that are clients find a server.
    """
    known_names = settings | {"LUMILINE_CONFIG"} | _OF_CLIENTS
    for name in sorted(os.environ):
        upper = name.upper()
        if not upper.startswith("LUMILINE_") or upper.startswith("LUMILINE_TEST_"):
            continue
        if upper not in known_names:
            near = difflib.get_close_matches(upper, known_names, n=1)
            meant = f"did you mean {near[0]}?" if near else "README.md and docs/ name them"
            raise ValueError(f"the environment has {name}, which is no setting; {meant}")
