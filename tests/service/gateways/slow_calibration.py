"""Calibration runs that wait for a file: of a note `until PATH`."""

import time
from pathlib import Path
from typing import Any

from service.api.runs.kinds import calibration

_compute = calibration.compute


def compute(report_progress: Any, device_id: str, request: calibration.Request) -> Any:
    """Wait, then calibrate."""
    if request.note.startswith("until "):
        while not Path(request.note.removeprefix("until ")).exists():
            report_progress(0.5, "waits")
            time.sleep(0.05)
    return _compute(report_progress, device_id, request)
