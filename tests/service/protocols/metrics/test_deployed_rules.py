"""The alert rules and the Grafana dashboard name metrics that /metrics has."""

import json
import re
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest

from service.backup.files import LAST_BACKUP
from tests.service.protocols.metrics.test_metrics import busy, cut_off, read, value

__all__ = ["busy", "cut_off"]

DEPLOY = Path(__file__).parents[4] / "deploy"


def names_in(file: str) -> set[str]:
    return set(re.findall(r"\blumiline_\w+", (DEPLOY / file).read_text()))


@pytest.mark.parametrize("file", ["alerts.yml", "grafana-dashboard.json"])
def test_metrics_that_a_file_names_exist(busy: Any, file: str) -> None:
    text = busy.get("/metrics").text
    known = set()
    for name, kind in re.findall(r"^# TYPE (\S+) (\S+)$", text, re.M):
        parts = ("_bucket", "_sum", "_count") if kind == "histogram" else ("",)
        known |= {name + part for part in parts}
    assert len(names_in(file)) > 8
    assert names_in(file) - known == set()


def test_every_panel_has_one_expression() -> None:
    panels = json.loads((DEPLOY / "grafana-dashboard.json").read_text())["panels"]
    assert all(len(panel["targets"]) == 1 for panel in panels)
    assert len({panel["id"] for panel in panels}) == len(panels)


def test_age_of_the_calibration_in_use(sqlite_client: Any) -> None:
    assert sqlite_client.post("/api/v1/calibrations/sim-nominal/activate").status_code == 200
    found = sqlite_client.get("/api/v1/calibrations/sim-nominal").json()
    created = datetime.fromisoformat(found["created_at"])
    age_s = value(read(sqlite_client), "lumiline_calibration_age_seconds", device="sim")
    assert 0.0 <= age_s <= (datetime.now(UTC) - created).total_seconds()
    assert "lumiline_drift_check_good{" not in sqlite_client.get("/metrics").text


def test_last_backup_is_what_the_note_says(sqlite_client: Any) -> None:
    name = "lumiline_last_backup_timestamp_seconds"
    assert value(read(sqlite_client), name) == 0.0
    at = datetime.now(UTC) - timedelta(days=1)
    note = sqlite_client.app.state.settings.data_dir / LAST_BACKUP
    note.write_text(json.dumps({"at": at.isoformat()}))
    assert value(read(sqlite_client), name) == pytest.approx(at.timestamp())
    note.write_text("{")
    assert value(read(sqlite_client), name) == 0.0


def test_failed_logins_are_counted(sqlite_client: Any) -> None:
    before = value(read(sqlite_client), "lumiline_logins_failed_total")
    refused = sqlite_client.get("/api/v1/devices", headers={"Authorization": "Bearer lumi_wrong"})
    assert refused.status_code == 401
    assert value(read(sqlite_client), "lumiline_logins_failed_total") == before + 1
