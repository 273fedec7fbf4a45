"""Subjects of the bus between machines: what is said on which, for permissions to be given by.

All begin with ``lumiline.v1.STATION``, and ids are of lower case letters, digits and hyphens, so
that none is two words of a subject, or a wildcard. docs/how-to/from-one-machine-to-many.md has the
table of who may publish and subscribe to which.
"""

from typing import Final

PREFIX: Final = "lumiline.v1"
ANY: Final = "*"

BATCH: Final = "batch"
"""Frames of a device, and what they are processed with."""
PIXELS: Final = "pixels"
"""The same with their pixels, while a gateway wants them."""
POSES: Final = "poses"
"""The newest poses of a device's tools."""
HOLDS: Final = "holds"
"""Beam holds: their changes, and again how long they are enabled."""
STATE: Final = "state"
"""States and figures of a station's devices."""
CALL: Final = "call"
"""Requests to a station, a word each."""
INBOX: Final = "inbox"
"""Answers to the gateways."""

BY_DEVICE: Final = (BATCH, PIXELS, POSES)
"""What has a subject for each device."""


def subject(station: str, kind: str, *words: str) -> str:
    """Return the subject of a station for a kind of message, and a device or a call."""
    return ".".join((PREFIX, station, kind, *words))


def inbox_prefix(who: str, process: str) -> str:
    """Return what the subjects of answers to a process begin with.

    Args:
        who: "gateway", or a station's name behind "station-": what permissions are given to.
        process: another for each process.
    """
    return f"{PREFIX}.{INBOX}.{who}.{process}"


def split_subject(text: str) -> tuple[str, str, str | None]:
    """Return station, kind, and device or call of a subject.

    Raises:
        ValueError: it is none of ours.
    """
    words = text.removeprefix(f"{PREFIX}.").split(".")
    if not text.startswith(f"{PREFIX}.") or not 2 <= len(words) <= 3:
        raise ValueError(f"{text!r} is no subject of a station")
    return words[0], words[1], words[2] if len(words) == 3 else None
