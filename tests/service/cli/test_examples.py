"""`lumiline examples`: files that the commands of the README take."""

import shlex
from pathlib import Path

import numpy as np
import pytest

from compute.optics.profiles.profile_loader import load_profile
from service.cli.json_files import read_calibration
from service.cli.observations_csv import read_observations, read_wand
from tests.service.cli.test_commands import here

ROOT = Path(__file__).parents[3]


def test_examples_are_read_by_the_commands(tmp_path: Path) -> None:
    folder = tmp_path / "examples"
    here("examples", folder)
    models = read_calibration(folder / "nominal.json").calibration.models
    wand = read_wand(folder / "waved.csv", 2).in_order_of(models)
    volume = read_observations(folder / "volume.csv").in_order_of(models)
    assert np.isfinite(wand.readings_px).mean() > 0.95
    assert np.isfinite(volume.readings_px).mean() > 0.9
    assert load_profile(folder / "my-bar.toml").name == "my-bar"
    before = (folder / "waved.csv").read_bytes()
    assert "exists" in here("examples", folder, "--seed", "2", code=2).stderr
    assert (folder / "waved.csv").read_bytes() == before


@pytest.mark.slow
def test_the_wand_of_the_readme_is_calibrated_without_a_warning(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    lines = (ROOT / "README.md").read_text(encoding="utf-8").splitlines()
    tour = [line for line in lines if line.startswith(("lumiline examples", "lumiline wand ex"))]
    assert len(tour) == 3
    for line in tour:
        assert "WARNING" not in here(*shlex.split(line, comments=True)[1:]).stdout
