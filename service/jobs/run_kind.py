"""RunKind: what a kind of run computes in its process, and how its result is stored."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from sqlalchemy.orm import Session

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
