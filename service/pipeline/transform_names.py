"""Names of tool transforms: ``probeToTracker``, ``probeToPatient``, cut to what fits a header."""

from dataclasses import dataclass
from typing import Final

NAME_BYTES: Final = 20
"""Longest name in a header of OpenIGTLink, and so in the sequence files that are like it."""
TRACKER: Final = "Tracker"
"""The frame of the device's own coordinates."""
TO: Final = "To"
_MAX_FRAME_BYTES: Final = NAME_BYTES - len(TO)
_MIN_FRAME_BYTES: Final = 9
"""What the second frame keeps of its name before the first is cut below what is left."""


@dataclass(frozen=True)
class TransformName:
    """The name of a transform.

    Args:
        short: at most 20 bytes, as the header has it.
        full: the whole name.
        frame: id of the tool that the transform is to; None: the tracker.
    """

    short: str
    full: str
    frame: str | None


def frame_name(tool: str | None) -> str:
    """Return a frame's name behind "To".

    With a capital, as "Tracker" has: readers find the "To" of ``probeToPatient`` by what is
    behind it, so that they do not take that of "toolTop" for it.
    """
    return TRACKER if tool is None else tool[:1].upper() + tool[1:]


def wire_name(tool: str, reference: str | None) -> TransformName:
    """Return the name of a tool's transform; both frames are cut where it is too long.

    The second keeps at least nine bytes of its name, and the first has the rest.
    """
    frame = frame_name(reference)
    full = f"{tool}{TO}{frame}"
    shortened = frame[: max(_MIN_FRAME_BYTES, _MAX_FRAME_BYTES - len(tool))]
    return TransformName(
        f"{tool[: _MAX_FRAME_BYTES - len(shortened)]}{TO}{shortened}", full, reference
    )
