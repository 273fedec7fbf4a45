"""`lumiline plan`: tables for people, JSON for machines, a picture, and what is refused."""

import json
from importlib import resources
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from service.cli import app


def run(*arguments: str | Path, code: int = 0) -> Any:
    result = CliRunner().invoke(app, ["plan", *map(str, arguments)], env={"COLUMNS": "80"})
    assert result.exit_code == code, result.output
    return result


@pytest.mark.slow
def test_tables_and_a_picture(tmp_path: Path) -> None:
    picture = tmp_path / "plan.png"
    text = run("bar", "--grid", "3", "--markers", "3", "--output", picture).output
    for part in (
        "four line sensors", "3 x 3 x 3 points", "noise, bound", "centre of gravity",
        "distortion, uncorrected", "accuracy budget", "calibration *", "dominates", "bar_gradient",
        "assumed: ", "diagonal-rising", "100 % of the volume", "strobed", "[2.15]",
    ):  # fmt: skip
        assert part in text
    assert picture.read_bytes().startswith(b"\x89PNG")


@pytest.mark.slow
def test_json_of_ones_own_file(tmp_path: Path) -> None:
    file = resources.files("compute.optics.profiles") / "devices" / "bar.toml"
    own = tmp_path / "own.toml"
    own.write_text(file.read_text("utf-8").replace('name = "bar"', 'name = "own"'), "utf-8")
    assumed = ("--assume", "temperature_change=40 K", "--assume", "control_points=300")
    found = json.loads(run(own, "--grid", "3", "--markers", "2", "--json", *assumed).stdout)
    assert found["budget"]["dominant"] == "warming"
    by_name = {one["name"]: one for one in found["budget"]["inputs"]}
    assert by_name["temperature_change"] == {
        "name": "temperature_change", "value": 40.0, "unit": "K", "assumed": False,
        "source": "given",
    }  # fmt: skip
    assert by_name["control_points"]["value"] == 300
    assert found["profile_id"] == "own"
    assert len(found["points"]) == 27
    assert found["noise"]["centre"][2] > found["noise"]["centre"][0] > 0.0
    assert [ghost["markers"] for ghost in found["ghosts"]] == [2]


def test_what_is_refused(tmp_path: Path) -> None:
    assert "bar, " in run("nothing", code=2).output
    assert "--grid" in run("bar", "--grid", "2", code=2).output
    assert "--markers" in run("bar", "--markers", "65", code=2).output
    assert "no such field" in run("bar", "--assume", "warmth=2 K", code=2).output
    nowhere = tmp_path / "no" / "plan.png"
    refused = run("bar", "--grid", "3", "--markers", "1", "--output", nowhere, code=2)
    assert "cannot be written" in " ".join(refused.output.split())


@pytest.mark.parametrize(
    "line", ['grid = "5 mm"', "][", "a = " + 5_000 * "[", "a = " + 5_000 * "9"], ids=range(4)
)
def test_a_file_that_is_no_profile_is_named(tmp_path: Path, line: str) -> None:
    own = tmp_path / "own.toml"
    own.write_text(line, "utf-8")
    assert "own.toml" in run(own, code=2).output.replace("\n", "")
