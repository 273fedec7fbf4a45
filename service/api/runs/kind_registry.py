"""The kinds of runs by name, and the resources that their results are."""

from collections import ChainMap
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Final

from service.api.exports.repository import ExportRepository
from service.api.runs.kinds import calibration, export, mapping, self_calibration, update
from service.jobs.run_manager import RunKind

if TYPE_CHECKING:
    from service.pipeline.detection_stage import FindProfile

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


def kinds_with(
    exports: ExportRepository, recordings: Path, find_profile: "FindProfile"
) -> Mapping[str, RunKind]:
    """Return all kinds.

    Args:
        exports: where export runs keep their files.
        recordings: the folder of what they export.
        find_profile: returns the device profiles that recordings name; can be pickled.
    """
    export_kind = RunKind(
        partial(export.task, exports, recordings, find_profile),
        partial(export.store, exports),
        _EXPORTS,
        exports.discard,
    )
    return ChainMap({"export": export_kind}, KINDS)
