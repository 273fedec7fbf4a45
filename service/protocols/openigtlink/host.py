"""ServerSettings; Host: what the application gives to the server: tools, landmarks, recordings."""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from service.api.tools.provenance import Provenance
from service.api.tools.tip_limit import TipLimit
from service.settings import Settings


@dataclass(frozen=True)
class ServerSettings:
    """Settings of one server; see those of the service that begin with openigtlink."""

    host: str = "127.0.0.1"
    port: int = 18944
    allow: tuple[str, ...] = ()
    device: str | None = None
    rate_hz: float = 250.0
    clients: int = 16
    stall_s: float = 10.0
    message_s: float = 30.0
    send_invalid: bool = False
    changes: bool = False


def server_settings(settings: Settings) -> ServerSettings | None:
    """Return the OpenIGTLink server's part of the service's settings; None: it is off."""
    if settings.openigtlink_port is None:
        return None
    names = (field.name for field in fields(ServerSettings))
    return ServerSettings(**{name: getattr(settings, f"openigtlink_{name}") for name in names})


Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class WireTool:
    """A tool as clients see it.

    Args:
        id: its name.
        device_id: the device that sees it.
        reference: id of the tool that its poses are given relative to; None: the tracker.
        markers_mm: its markers in its own coordinates, shape (M, 3) [mm]; None: not told.
        tip_mm: its tip in its own coordinates, shape (3,) [mm]; None: its origin.
        limit: on the error of its poses; None: they are worth what the tracker says.
    """

    id: str
    device_id: str
    reference: str | None = None
    markers_mm: Array | None = None
    tip_mm: Array | None = None
    limit: TipLimit | None = None


@dataclass(frozen=True)
class Landmark:
    """A point that somebody has marked.

    Args:
        name: of it.
        position_mm: in the coordinates of ``owner`` [mm].
        owner: the tool, or the device, that it is fixed to.
        made_with: the registration that it is of, and what that was measured with; None: it
            holds with whatever is active.
    """

    name: str
    position_mm: tuple[float, float, float]
    owner: str
    provenance: Provenance | None = None


Outcome = Literal["done", "refused"]


class Host(Protocol):
    """The application; all methods may be slow and are awaited. They raise LumilineError."""

    async def tools(self) -> Sequence[WireTool]:
        """Return the tools of all devices."""
        ...

    async def landmarks(self, device_id: str) -> Sequence[Landmark]:
        """Return the points that have been marked."""
        ...

    async def devices(self) -> Sequence[str]:
        """Return the devices that run."""
        ...

    async def start_recording(self, device_id: str, name: str | None) -> str:
        """Begin to record a device; returns the recording's name."""
        ...

    async def stop_recording(self, device_id: str) -> str:
        """End the recording of a device; returns what was recorded, in words."""
        ...

    async def audit(
        self, operation: str, address: str, outcome: Outcome, detail: str | None
    ) -> None:
        """Write down what the client at an address changed, or wanted to; never raises."""
        ...
