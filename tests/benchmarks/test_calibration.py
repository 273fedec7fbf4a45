"""The calibration benchmark solves one problem in every row, and says what it could not run."""

import numpy as np
import pytest
from scipy.optimize import approx_fprime

from benchmarks import calibration
from benchmarks.calibration_peers import Bundle, Solver, by_scipy, pyceres_solver


def test_every_method_reaches_the_minimum_from_nearby_and_from_nothing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(calibration, "FRAMES", 2)
    monkeypatch.setattr(calibration, "STARTS", ("1 % wrong",))
    rows = [row for row in calibration.run(seconds=0.0) if row["note"] is None]
    # Seven of the eleven are determined: from nearby all end at our minimum.
    assert all(row["minimum_reached"] == row["of"] == 8 for row in rows)
    ours = {row["job"]: row["time_ms"] for row in rows if row["method"] == calibration.OURS}
    assert list(ours) == [calibration.MINIMUM, calibration.COVARIANCE, calibration.ALL]
    for row in rows:
        assert row["times_ours"] == pytest.approx(row["time_ms"] / ours[row["job"]])  # type: ignore[operator]


def test_a_peer_that_is_not_installed_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing() -> Solver:
        raise ImportError

    monkeypatch.setattr(calibration, "FRAMES", 1)
    monkeypatch.setattr(calibration, "STARTS", ("1 % wrong",))
    monkeypatch.setattr(calibration, "pyceres_solver", missing)
    rows = calibration.run(seconds=0.0)
    (note,) = {row["note"] for row in rows} - {None}
    assert "pip install pyceres" in str(note)


def test_slopes_are_those_of_the_values() -> None:
    frame = calibration.frames()[0]
    bundle = Bundle(frame.points_mm, frame.readings_px[:, 1])
    x = calibration.near_start(frame.models[1], np.random.default_rng(2))
    numerical = approx_fprime(x, bundle.values, 1e-7)
    np.testing.assert_allclose(bundle.slopes(x), numerical, rtol=1e-4, atol=1e-3)


def test_the_linear_start_is_near_the_minimum() -> None:
    frame = calibration.frames()[0]
    for bundle, sensor in zip(calibration.bundles(frame), frame.sensors, strict=True):
        start = bundle.linear_start(sensor.name)
        least = bundle.squares(by_scipy(bundle, start).x)
        assert least < bundle.squares(start) < 10.0 * least


@pytest.mark.parametrize("name", ["scipy", "pyceres"])
def test_the_peers_covariance_is_ours(name: str) -> None:
    """By the deviations of the readings, which no gauge changes."""
    if name == "pyceres":
        pytest.importorskip("pyceres")
    solver: Solver = by_scipy if name == "scipy" else pyceres_solver()
    frame = calibration.frames()[0]
    _, cameras, ours = calibration.our_minimum(frame, frame.models, covariance=True)
    assert ours is not None
    slopes = cameras.parameter_jacobian(frame.points_mm)
    wanted = np.einsum("nsi,sij,nsj->sn", slopes, ours, slopes)
    for bundle, sensor, own in zip(calibration.bundles(frame), frame.sensors, wanted, strict=True):
        found = solver(bundle, bundle.linear_start(sensor.name), covariance=True)
        assert found.covariance is not None
        rows = bundle.slopes(found.x)
        np.testing.assert_allclose(
            np.einsum("ni,ij,nj->n", rows, found.covariance, rows), own, rtol=1e-3
        )


def test_the_table_is_printed(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(calibration, "FRAMES", 1)
    monkeypatch.setattr(calibration, "STARTS", ("1 % wrong",))
    assert calibration.main(["--seconds", "0"]) == 0
    printed = capsys.readouterr().out
    assert calibration.OURS in printed
    assert "of 4" in printed
