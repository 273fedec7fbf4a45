"""Largest bodies by path."""

from pathlib import Path

import pytest

from service.application.app import (
    OBSERVATION_BODY_BYTES,
    SMALL_BODY_BYTES,
    body_limits,
    create_app,
)
from service.settings import Settings
from tests.openapi_document import openapi_document
from tests.service.fake_pipeline import FakePipeline, TestClient


@pytest.mark.parametrize(
    ("path", "limit"),
    [
        ("devices", SMALL_BODY_BYTES),
        ("keys", SMALL_BODY_BYTES),
        ("tools", SMALL_BODY_BYTES),
        ("reconstructions", OBSERVATION_BODY_BYTES),
        ("runs/mapping", OBSERVATION_BODY_BYTES),
    ],
)
def test_body_longer_than_path_takes_is_refused(tmp_path: Path, path: str, limit: int):
    app = create_app(Settings(data_dir=tmp_path), FakePipeline())
    with TestClient(app) as client:
        answer = client.post(
            f"/api/v1/{path}",
            content=b"[" + b" " * limit,
            headers={"content-type": "application/json"},
        )
        assert answer.status_code == 413
        assert answer.json()["type"] == "/problems/body-too-large"
        assert str(limit) in answer.json()["detail"]


def test_body_limits_of_paths_are_of_operations(tmp_path: Path):
    settings = Settings(data_dir=tmp_path)
    paths = openapi_document()["paths"]
    assert [path for path in body_limits(settings) if "post" not in paths.get(path, {})] == []
