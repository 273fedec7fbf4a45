"""What each kind of run computes in its process, and what is stored of it."""

from collections import ChainMap
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Final

from sqlalchemy.orm import Session

from service.api.exports.repository import ExportRepository
from service.api.runs.kinds import calibration, export, mapping, self_calibration, update
from service.database.models import RunRow

Task = tuple[Callable[..., Any], tuple[Any, ...]]


@dataclass(frozen=True)
class RunKind:
    """One kind of run.

    Args:
        task: returns the function to call in the process and its arguments, from a run's row.
        store: stores its result and returns the id under which it is found.
        results: path of the resource that the results are of.
        ended: called with the id of a run that has ended in any way, whatever was stored.
    """

    task: Callable[[Session, RunRow], Task]
    store: Callable[[Session, RunRow, Any], str]
    results: str
    ended: Callable[[str], None] = lambda _: None


KINDS: Final[dict[str, RunKind]] = {
    "calibration": RunKind(calibration.task, calibration.store, "/api/v1/calibrations"),
    "self-calibration": RunKind(
        self_calibration.task, self_calibration.store, "/api/v1/calibrations"
    ),
    "update": RunKind(update.task, update.store, "/api/v1/calibrations"),
    "mapping": RunKind(mapping.task, mapping.store, "/api/v1/correction-tables"),
}
"""Those that need nothing but the database."""
_EXPORTS: Final = "/api/v1/exports"
RESULTS: Final[Mapping[str, str]] = {
    **{name: kind.results for name, kind in KINDS.items()},
    "export": _EXPORTS,
}
"""Paths of the resources that results are of, by the kind of run."""


def kinds_with(exports: ExportRepository, recordings: Path) -> Mapping[str, RunKind]:
    """Return all kinds.

    Args:
        exports: where export runs keep their files.
        recordings: the folder of what they export.
    """
    made = RunKind(
        partial(export.task, exports, recordings),
        partial(export.store, exports),
        _EXPORTS,
        exports.discard,
    )
    return ChainMap({"export": made}, KINDS)
