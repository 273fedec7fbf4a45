"""The dashboard: served whole, and only from here."""

import re
from pathlib import Path
from typing import Any

import pytest

from service.application import dashboard
from tests.service.application.test_security_headers import check_headers


def test_page_and_all_its_files_are_served(sqlite_client: Any):
    page = sqlite_client.get("/")
    assert page.status_code == 200
    policy = check_headers(page)
    assert "unsafe-inline" not in policy
    assert page.headers["cache-control"] == "no-cache"
    loaded = re.findall(r'(?:src|href)="([^"]+)"', page.text)
    assert {path.rpartition(".")[2] for path in loaded} == {"js", "css", "svg"}
    for path in loaded:
        file = sqlite_client.get(path.removeprefix("."))
        assert file.status_code == 200, path
        assert "immutable" in file.headers["cache-control"]
        check_headers(file)
    assert "<script>" not in page.text


@pytest.mark.parametrize("name", ["none.js", "%2e%2e", "%2e%2e%2fsources.sha256"])
def test_no_other_file_is_served(sqlite_client: Any, name: str):
    assert sqlite_client.get(f"/dashboard/{name}").status_code in (404, 422)


def test_source_tree_without_a_page_says_how_to_build_it(
    sqlite_client: Any, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
):
    monkeypatch.setattr(dashboard, "_PAGE", tmp_path)
    page = sqlite_client.get("/")
    assert page.status_code == 503
    assert "make dashboard" in page.text
