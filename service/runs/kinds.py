"""What each kind of run computes in its process, and what is stored of it."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

from sqlalchemy.orm import Session

from service.database.models import RunRow
from service.runs import calibration, mapping, self_calibration, update

Task = tuple[Callable[..., Any], tuple[Any, ...]]


@dataclass(frozen=True)
class RunKind:
    """One kind of run.

    Args:
        task: returns the function to call in the process and its arguments, from a run's row.
        store: stores its result and returns the id under which it is found.
        results: path of the resource that the results are of.
    """

    task: Callable[[Session, RunRow], Task]
    store: Callable[[Session, RunRow, Any], str]
    results: str


KINDS: Final[dict[str, RunKind]] = {
    "calibration": RunKind(calibration.task, calibration.store, "/api/v1/calibrations"),
    "self-calibration": RunKind(
        self_calibration.task, self_calibration.store, "/api/v1/calibrations"
    ),
    "update": RunKind(update.task, update.store, "/api/v1/calibrations"),
    "mapping": RunKind(mapping.task, mapping.store, "/api/v1/correction-tables"),
}
