"""The command line: version, document, settings that are wrong."""

import json
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from service.application.app import create_app
from service.cli import app
from service.settings import Settings
from service.version import DISCLAIMER, package_version


def run(*arguments: str) -> Any:
    return CliRunner().invoke(app, list(arguments))


def test_version():
    result = run("--version")
    assert (result.exit_code, result.output.splitlines()) == (0, [package_version(), DISCLAIMER])


@pytest.mark.slow
def test_openapi_prints_the_served_document():
    result = run("openapi")
    assert result.exit_code == 0
    assert json.loads(result.output) == create_app(Settings()).openapi()


def test_serve_hands_the_settings_to_uvicorn(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    calls: list[Any] = []
    monkeypatch.setattr(
        "service.application.shutdown.run_server", lambda app, given, _: calls.append((app, given))
    )
    monkeypatch.setattr("service.cli.preflight.check_ports", lambda _: None)
    monkeypatch.setenv("LUMILINE_PORT", "1234")
    result = run(
        "serve", "--data-dir", str(tmp_path), "--compute-device", "cpu", "--host", "0.0.0.0"
    )
    assert result.exit_code == 0
    [(served, given)] = calls
    assert served.state.settings == Settings(
        data_dir=tmp_path, compute_device="cpu", host="0.0.0.0", port=1234
    )
    assert (given["host"], given["port"]) == ("0.0.0.0", 1234)
    assert given["ws_per_message_deflate"] is False


def test_a_wrong_setting_is_named(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(
        "service.application.shutdown.run_server", lambda *_, **__: pytest.fail("must not run")
    )
    result = run("serve", "--port", "70000")
    assert result.exit_code == 2
    assert "setting port" in result.output
    assert "70000" in result.output


@pytest.mark.parametrize(
    "text",
    [
        'database_ur1 = "postgresql+psycopg://user:s3cret@host/db"',
        'database_url = ["postgresql+psycopg://user:s3cret@host/db"]',
        '[database]\nurl = "postgresql+psycopg://user:s3cret@host/db"',
    ],
)
@pytest.mark.parametrize("command", ["serve", "openapi"])
def test_a_wrong_setting_does_not_print_the_password(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, text: str, command: str
):
    monkeypatch.setattr(
        "service.application.shutdown.run_server", lambda *_, **__: pytest.fail("must not run")
    )
    (tmp_path / "lumiline.toml").write_text(text)
    monkeypatch.setenv("LUMILINE_CONFIG", str(tmp_path / "lumiline.toml"))
    result = run(command)
    assert result.exit_code == 2
    assert "setting database" in result.output
    assert "s3cret" not in result.output
    if "database_url" not in text:
        assert "there are data_dir, database_url, host" in result.output
