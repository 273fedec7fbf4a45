"""The calibration benchmark solves one problem in every row, and says what it could not run."""

import numpy as np
import pytest
from scipy.optimize import approx_fprime

from benchmarks import calibration


def test_every_method_reaches_the_minimum_from_nearby(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(calibration, "FRAMES", 2)
    rows = calibration.run(seconds=0.0)
    assert rows[0]["method"] == calibration.OURS
    assert rows[0]["minimum_reached"] == rows[0]["of"] == 8
    ran = [row for row in rows if row["note"] is None]
    assert {row["start"] for row in ran[1:]} == {"1 % wrong", "Table 5.11"}
    # Seven of the eleven are determined: from nearby all end at our minimum.
    assert all(row["minimum_reached"] == 8 for row in ran if row["start"] == "1 % wrong")
    assert all(row["times_ours"] == row["time_ms"] / rows[0]["time_ms"] for row in ran)  # type: ignore[operator]


def test_a_peer_that_is_not_installed_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing() -> calibration.Solver:
        raise ImportError

    monkeypatch.setattr(calibration, "FRAMES", 1)
    monkeypatch.setattr(calibration, "pyceres_solver", missing)
    rows = calibration.run(seconds=0.0)
    (note,) = {row["note"] for row in rows} - {None}
    assert "pip install pyceres" in str(note)


def test_slopes_are_those_of_the_values() -> None:
    frame = calibration.frames()[0]
    bundle = calibration.Bundle(frame.points_mm, frame.readings_px[:, 1])
    x = calibration.near_start(frame.models[1], np.random.default_rng(2))
    numerical = approx_fprime(x, bundle.values, 1e-7)
    np.testing.assert_allclose(bundle.slopes(x), numerical, rtol=1e-4, atol=1e-3)


def test_the_table_is_printed(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(calibration, "FRAMES", 1)
    assert calibration.main(["--seconds", "0"]) == 0
    printed = capsys.readouterr().out
    assert calibration.OURS in printed
    assert "of 4" in printed
