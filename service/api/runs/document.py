"""A run's row as clients see it."""

from service.api.runs.kind_registry import RESULTS
from service.api.runs.schema import Run
from service.database.models import RunRow


def run_document(row: RunRow) -> Run:
    """Return the run."""
    result = None
    if row.result_id is not None:
        result = f"{RESULTS[row.kind]}/{row.result_id}"
    return Run.model_validate(
        {
            "id": row.id,
            "kind": row.kind,
            "device": row.device_id,
            "state": row.state,
            "progress": row.progress,
            "stage": row.stage,
            "result_id": row.result_id,
            "result": result,
            "problem": row.problem,
            "created_at": row.created_at,
            "started_at": row.started_at,
            "finished_at": row.finished_at,
        }
    )
