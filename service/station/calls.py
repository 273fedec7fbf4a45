"""Messages between gateway and station beside the bus: calls, their answers, log lines.

Pickled: both ends are one program, and the socket between them has no name.
"""

import copyreg
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

from service.pipeline.detection_stage import FindProfile


def _mapping(members: dict[Any, Any]) -> MappingProxyType[Any, Any]:
    return MappingProxyType(members)


def _reduce_mapping(mapping: MappingProxyType[Any, Any]) -> tuple[Any, ...]:
    return _mapping, (dict(mapping),)


# Profiles, and so the drivers made of them, have read-only mappings.
copyreg.pickle(MappingProxyType, _reduce_mapping)


@dataclass(frozen=True)
class Start:
    """First message to a station.

    Args:
        compute_device: "cpu", "cuda:0", ...; None: the best there is.
        find_profile: returns the device profiles that descriptions name.
        log_level: of the lines that are wanted.
        priority: of real time, 1 to 99; None: as all others.
        cores: numbers of the cores that it may use; empty: all.
    """

    compute_device: str | None
    find_profile: FindProfile
    log_level: int
    priority: int | None = None
    cores: tuple[int, ...] = ()


@dataclass(frozen=True)
class Call:
    """A method of the station, with its arguments.

    Args:
        number: of the answer; None: none is wanted.
        method: its name.
        args: by position.
        members: by name.
    """

    number: int | None
    method: str
    args: tuple[Any, ...]
    members: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Answer:
    """What became of a call.

    Args:
        number: of the call.
        result: what the method returned.
        error: what it raised; None: nothing.
        head: position of the bus behind all that the call caused.
    """

    number: int
    result: Any
    error: BaseException | None
    head: int


@dataclass(frozen=True)
class LogLine:
    """A line of the station's log: the members of its record."""

    members: dict[str, Any]
