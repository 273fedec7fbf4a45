"""Identity: model, serial number and versions that the server reports."""

from dataclasses import dataclass
from typing import Final

API_REVISION: Final = "G.002.001"
"""The common API with BX; BX2 begins with G.003."""


@dataclass(frozen=True)
class Identity:
    """What clients are told that they speak to.

    Args:
        model: the kind of tracker; some drivers look for a word in it.
        version: ours.
        serial: name of the device that is tracked.
    """

    model: str
    version: str
    serial: str

    def firmware(self) -> str:
        """Return the reply to VER: lines that drivers look through for their beginnings."""
        return (
            f"{self.model} Control Firmware\n"
            f"NDI S/N: {self.serial}\n"
            f"Freeze Tag: {self.model} {self.version}\n"
            "Lumiline answers the common API; no product of Northern Digital Inc.\n"
        )


def features(option: int, sockets: int) -> str | None:
    """Return the reply to SFLIST; None: there is no such option.

    Args:
        option: 0: summary, 1: ports of active tools, 2: of passive ones, 3: volumes, 4: ports that
            sense current, 5: wireless ports.
        sockets: tools that can be plugged in.
    """
    return {0: "00000003", 1: f"{min(sockets, 15):X}", 2: "9", 3: "0", 4: "0", 5: "0"}.get(option)
