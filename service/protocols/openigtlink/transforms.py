"""Names of tool transforms, unique on the wire; transforms that clients have set by name."""

import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Final

import numpy as np
from numpy.typing import NDArray

from service.pipeline.transform_names import NAME_BYTES, TO, TRACKER, TransformName, wire_name
from service.protocols.openigtlink.host import WireTool
from service.protocols.openigtlink.message import CommandRefused

_TO_OF_ITS_OWN: Final = re.compile(r"to[^a-z]")
"""How a reference begins whose frame looks like a "To" and a frame: "To-1", not "Tool"."""


@dataclass(frozen=True)
class ToolNames:
    """Names of all tools of a device."""

    names: Mapping[str, TransformName]
    refused: Mapping[str, str]


def name_tools(tools: Sequence[WireTool]) -> ToolNames:
    """Name all tools; those whose name would be another's too are all refused."""
    tool_ids = {tool.id for tool in tools}
    names: dict[str, TransformName] = {}
    refused: dict[str, str] = {}
    for tool in tools:
        wrong = _wrong(tool, tool_ids)
        if wrong is None:
            names[tool.id] = wire_name(tool.id, tool.reference)
        else:
            refused[tool.id] = wrong
    counts = Counter(name.short for name in names.values())
    for one, name in list(names.items()):
        if counts[name.short] > 1:
            others = sorted(other for other in names if names[other].short == name.short)
            refused[one] = (
                f'the names of {", ".join(others)} are cut to the same "{name.short}": a name has '
                f"{NAME_BYTES} bytes; give the tools shorter ids"
            )
    accepted = {one: name for one, name in names.items() if one not in refused}
    return ToolNames(MappingProxyType(accepted), MappingProxyType(refused))


def _wrong(tool: WireTool, tool_ids: set[str]) -> str | None:
    for frame in filter(None, (tool.id, tool.reference)):
        if TO in frame or not frame.isascii():
            return f'"{frame}" cannot be the name of a frame: it has "{TO}" in it, or is not ASCII'
    if tool.id == tool.reference or tool.id == TRACKER:
        return f'"{tool.id}" cannot be given relative to itself, nor be called like the tracker'
    if tool.reference is not None and _TO_OF_ITS_OWN.match(tool.reference):
        return (
            f'in "{wire_name(tool.id, tool.reference).full}" each "{TO}" may be the one between '
            f'the frames: give the reference "{tool.reference}" another id'
        )
    if tool.reference is not None and tool.reference not in tool_ids:
        return f'its reference "{tool.reference}" is no tool of the same device'
    return None


Array = NDArray[np.float64]

MAX_TRANSFORMS: Final = 100
_NAME: Final = re.compile(r"[A-Za-z0-9_-]+?To[A-Z0-9_-][A-Za-z0-9_-]*")
_NAME_CHARACTERS: Final = 100
_DATE_CHARACTERS: Final = 100


@dataclass(frozen=True, eq=False)
class NamedTransform:
    """A transform that somebody has set.

    Args:
        matrix: shape (4, 4), translation in mm.
        error: what its maker says of its error; None: nothing.
        date: likewise of its date.
    """

    matrix: Array
    error: float | None = None
    date: str | None = None


class Transforms:
    """Kept until the server ends; at most MOST."""

    def __init__(self) -> None:
        self._named: dict[str, NamedTransform] = {}

    def set(self, name: str, transform: NamedTransform) -> None:
        """Keep a transform under its name; raises CommandRefused when there is no room."""
        if name not in self._named and len(self._named) >= MAX_TRANSFORMS:
            raise CommandRefused(
                f"{MAX_TRANSFORMS} transforms are kept, and {name} would be one more"
            )
        self._named[name] = transform

    def find(self, name: str) -> NamedTransform | None:
        """Return a transform by its name, or the inverse of the one in the other direction."""
        transform = self._named.get(name)
        if transform is not None:
            return transform
        inverse_name = inverse_of(name, self._named)
        if inverse_name is None:
            return None
        opposite = self._named[inverse_name]
        try:
            inverse = np.linalg.inv(opposite.matrix).astype(np.float64)
        except np.linalg.LinAlgError:
            return None
        return NamedTransform(inverse, opposite.error, opposite.date)


def read_name(text: str) -> str:
    """Return a transform's name, FromToTo; raises CommandRefused."""
    if len(text) > _NAME_CHARACTERS or _NAME.fullmatch(text) is None:
        raise CommandRefused(
            f'TransformName "{text[:_NAME_CHARACTERS]}"; it must be such as probeToTracker: two '
            "frames, and To between them"
        )
    return text


def opposite_name(name: str) -> str:
    """Return the name of the inverse transform; a text that is no name stays."""
    first, _, second = name.partition("To")
    return f"{second}To{first}" if second else name


def inverse_of(name: str, names: Iterable[str]) -> str | None:
    """Return that of the known names whose inverse is wanted; None: there is none, or several.

    A frame that has a capital behind "To" may have none before it: of ``probeToTracker`` both
    ``TrackerToProbe`` and ``TrackerToprobe`` are the inverse.
    """
    opposite = opposite_name(name)
    alike = {one for one in names if one == opposite or _capital(one) == _capital(opposite)}
    if opposite in alike:
        return opposite
    return alike.pop() if len(alike) == 1 else None


def _capital(name: str) -> tuple[str, ...]:
    return tuple(frame[:1].upper() + frame[1:] for frame in name.split("To", maxsplit=1))


def read_matrix(text: str) -> Array:
    """Return 16 numbers as a matrix (4, 4); raises CommandRefused."""
    try:
        matrix = np.array([float(one) for one in text.split()])
    except ValueError:
        matrix = np.empty(0)
    if matrix.shape != (16,) or not np.isfinite(matrix).all():
        raise CommandRefused("TransformValue must be 16 finite numbers, row by row")
    matrix = matrix.reshape(4, 4)
    if not np.array_equal(matrix[3], [0.0, 0.0, 0.0, 1.0]):
        raise CommandRefused(f"the last row of TransformValue is {matrix[3].tolist()}; 0 0 0 1")
    return matrix


def read_error(text: str | None) -> float | None:
    """Return TransformError; raises CommandRefused."""
    if text is None:
        return None
    try:
        error = float(text)
    except ValueError:
        error = -1.0
    if not 0.0 <= error < float("inf"):
        raise CommandRefused(f'TransformError "{text[:_DATE_CHARACTERS]}"; a number from 0 on')
    return error


def read_date(text: str | None) -> str | None:
    """Return TransformDate; raises CommandRefused when it is too long to be one."""
    if text is not None and len(text) > _DATE_CHARACTERS:
        raise CommandRefused(f"TransformDate has {len(text)} characters; {_DATE_CHARACTERS} fit")
    return text


def write_matrix(matrix: Array) -> str:
    """Return a matrix row by row, as PLUS writes it."""
    return " ".join(f"{value:.9g}" for value in matrix.ravel())
