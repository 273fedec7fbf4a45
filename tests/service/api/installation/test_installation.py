"""The settings in force and the backups, over REST."""

from pathlib import Path
from typing import Any

import pytest

from service.application.app import create_app
from service.backup.files import back_up_files
from service.settings import Settings
from tests.service.fake_pipeline import TestClient


def settings_of(client: Any) -> dict[str, Any]:
    found: dict[str, Any] = {}
    cursor = ""
    while cursor is not None:
        page = client.get(
            "/api/v1/settings", params={"limit": 20} | ({"cursor": cursor} if cursor else {})
        )
        assert page.status_code == 200, page.text
        found |= {one["name"]: one for one in page.json()["items"]}
        cursor = page.json()["next_cursor"]
    return found


@pytest.mark.slow
def test_all_settings_are_listed_with_what_is_in_force(tmp_path: Path) -> None:
    given = Settings(data_dir=tmp_path, compute_device="cpu", recording_max_age_days=30)
    with TestClient(create_app(given)) as client:
        found = settings_of(client)
    assert found.keys() == Settings.model_fields.keys()
    assert (
        found["recording_max_age_days"]["value"],
        found["recording_max_age_days"]["is_default"],
    ) == (30, False)
    assert (found["runs_at_once"]["value"], found["runs_at_once"]["is_default"]) == (1, True)
    assert found["data_dir"]["value"] == str(tmp_path)
    assert "last changed longer ago are deleted" in found["recording_max_age_days"]["description"]
    assert all(one["description"] for one in found.values())


def test_the_password_of_a_database_is_hidden(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from service.api.installation.router import _setting

    secret = Settings(
        data_dir=tmp_path, database_url="postgresql+psycopg://me:hunter2@host/lumiline"
    )
    shown = _setting(secret, "database_url").value
    assert shown == "postgresql+psycopg://me:***@host/lumiline"


@pytest.mark.slow
def test_backups_are_listed_newest_first(tmp_path: Path) -> None:
    given = Settings(data_dir=tmp_path / "data", compute_device="cpu")
    folder = tmp_path / "backups"
    with TestClient(create_app(given)) as client:
        assert client.get("/api/v1/backups").json()["items"] == []
        made, _ = back_up_files(client.app.state.database, given, folder)
        for name in ("20200101T000000Z", "renamed"):
            (folder / name).mkdir()
            (folder / name / "database.lumiline").write_bytes(b"12345")
        newest, oldest = client.get("/api/v1/backups").json()["items"]
        assert newest["path"] == str(made)
        assert (oldest["created_at"], oldest["database_bytes"]) == (
            "2020-01-01T00:00:00Z",
            5,
        )
        assert oldest["id"] == "20200101T000000Z"
