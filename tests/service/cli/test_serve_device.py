"""`lumiline serve --profile`: what is prepared, logged and refused, each in one line."""

import sqlite3
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from service.cli import app
from tests.service.renamed_profiles import LENS, WINDOW, renamed_profile


@pytest.fixture(autouse=True)
def nothing_set(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    for name in ("CONFIG", "DATABASE_URL", "PROFILE"):
        monkeypatch.delenv(f"LUMILINE_{name}", raising=False)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("LUMILINE_PORT", "0")
    monkeypatch.setattr("service.application.shutdown.run_server", lambda *_, **__: None)


def serve(tmp_path: Path, *arguments: str | Path, code: int = 0) -> Any:
    command = ["serve", "--data-dir", str(tmp_path / "data"), *map(str, arguments)]
    result = CliRunner().invoke(app, command)
    assert result.exit_code == code, result.output
    return result


def devices(tmp_path: Path) -> list[str]:
    with closing(sqlite3.connect(tmp_path / "data" / "lumiline.sqlite3")) as connection:
        return [row[0] for row in connection.execute("SELECT id FROM devices ORDER BY id")]


def test_a_built_in_profile(tmp_path: Path) -> None:
    result = serve(tmp_path, "--profile", WINDOW)
    assert devices(tmp_path) == [WINDOW, "sim"]
    assert f"device {WINDOW}: tracing its optics" in result.stderr
    assert result.stdout == ""


@pytest.mark.slow
def test_the_optics_are_ready_before_devices_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A device of lenses is calibrated and its optics traced, as its settings say, once each."""
    from service.api.devices import nominal_calibration

    traced: list[tuple[str, str]] = []
    optics = nominal_calibration.profile_optics

    def tells(profile: Any, mode: Any) -> Any:
        traced.append((profile.name, mode))
        return None if mode == "tabulated" else optics(profile, mode)

    monkeypatch.setattr(nominal_calibration, "profile_optics", tells)
    monkeypatch.setattr("compute.optics.profiles.profile_optics.profile_optics", tells)
    first = serve(tmp_path, "--profile", LENS)
    assert "fitting its calibration" in first.stderr
    assert traced == [(LENS, "exact"), (LENS, "tabulated")]
    assert devices(tmp_path) == ["sim", "thesis-5-9"]
    second = serve(tmp_path, "--profile", LENS)
    assert "fitting its calibration" not in second.stderr
    assert traced[2:] == [(LENS, "tabulated")]


def test_ones_own_file_by_option_variable_and_configuration(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("one", "two", "three"):
        (tmp_path / f"{name}.toml").write_text(renamed_profile(name), "utf-8")
    serve(tmp_path, "--profile", "one.toml")
    monkeypatch.setenv("LUMILINE_PROFILE", "two.toml")
    serve(tmp_path)
    monkeypatch.delenv("LUMILINE_PROFILE")
    (tmp_path / "lumiline.toml").write_text('profile = "three.toml"\n', "utf-8")
    serve(tmp_path)
    assert devices(tmp_path) == ["one", "sim", "three", "two"]
    kept = (tmp_path / "data" / "profiles").iterdir()
    assert sorted(file.name for file in kept) == ["one.toml", "three.toml", "two.toml"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "words"),
    [
        (('pitch = "14 um"', 'pitch = "14"'), ["pixels.pitch", '"14" has no unit']),
        (('pitch = "14 um"', 'pich = "14 um"'), ["pixels.pich", "no such field"]),
        (('exposure = "150 us"', 'exposure = "150 ms"'), ["rates.exposure"]),
        (("[pixels]", "[pixels"), ["not TOML", "line "]),
        (('"coda-mpx30"', '"bar"'), ["built-in"]),
        (('"coda-mpx30"', '"My Bar"'), ["'My Bar'", "lower case"]),
        (('"coda-mpx30"', '"sim"'), ['device "sim" is there already', "simulated"]),
    ],
)
def test_a_profile_that_cannot_be_used(
    tmp_path: Path, change: tuple[str, str], words: list[str]
) -> None:
    text = renamed_profile(WINDOW)
    assert change[0] in text
    (tmp_path / "own.toml").write_text(text.replace(*change), "utf-8")
    [line] = serve(tmp_path, "--profile", "own.toml", code=2).output.splitlines()
    for word in ("error: setting profile: ", *words):
        assert word in line
    assert devices(tmp_path) == ["sim"]
    assert not (tmp_path / "data" / "profiles").exists()


def test_no_such_profile(tmp_path: Path) -> None:
    [line] = serve(tmp_path, "--profile", "optotrack", code=2).output.splitlines()
    assert 'setting profile: profile "optotrack" cannot be read' in line
    assert "optotrak, " in line


def test_another_file_of_the_same_name(tmp_path: Path) -> None:
    (tmp_path / "own.toml").write_text(renamed_profile("own"), "utf-8")
    serve(tmp_path, "--profile", "own.toml")
    (tmp_path / "own.toml").write_text(renamed_profile("own") + "# changed\n", "utf-8")
    [line] = serve(tmp_path, "--profile", "own.toml", code=2).output.splitlines()
    assert "another profile of this name is in use" in line


def test_a_folder_of_profiles_that_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / "own.toml").write_text(renamed_profile("own"), "utf-8")
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "profiles").write_text("", "utf-8")
    [line] = [
        line
        for line in serve(tmp_path, "--profile", "own.toml", code=1).output.splitlines()
        if line.startswith("error: ")
    ]
    assert "data directory" in line
    assert devices(tmp_path) == ["sim"]
