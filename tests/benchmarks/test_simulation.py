"""The benchmark of simulated frames renders what it says: the same light by all ways."""

import numpy as np
import pytest

from benchmarks import simulation
from compute.optics.profiles.profile_loader import load_profile
from compute.optics.profiles.profile_optics import profile_optics


@pytest.fixture(scope="module")
def scene():
    return simulation.Scene(load_profile(simulation.PROFILE))


def test_frames_have_all_markers_on_all_lines(scene):
    signal = scene.signal(profile_optics(scene.profile, "exact"), 0)
    assert signal.shape == (simulation.FRAMES, 4, 2048)
    # The bar's volume is seen by all four sensors whole.
    ideal = scene.ideal()(0)
    for lines in (signal, ideal):
        per_line = (lines > 0.01 * lines.max()).sum(axis=2)
        assert (per_line > simulation.MARKERS).all()
    middle = (signal * np.arange(2048)).sum(axis=2) / signal.sum(axis=2)
    peer = (ideal * np.arange(2048)).sum(axis=2) / ideal.sum(axis=2)
    # The peer's lens is another, but what it shows is the same.
    assert np.corrcoef(middle.ravel(), peer.ravel())[0, 1] > 0.995


def test_detectors(scene):
    even, shaped = scene.array(scene.even), scene.array(scene.patterned, scene.shaped_background())
    assert np.ptp(even.unlit_electrons) == 0.0
    assert shaped.unlit_electrons.mean() > even.unlit_electrons.mean() + 50.0
    counts = scene.expose(even, np.zeros((2, 4, 2048)))
    assert counts.shape == (2, 4, 2048)
    assert counts.dtype == np.uint16


@pytest.mark.slow
def test_every_method_is_measured():
    rows = simulation.run(seconds=0.0)
    assert len(rows) == 8
    whole = next(row for row in rows if row["method"] == simulation.WHOLE)
    assert whole["times_whole"] == 1.0
    for row in rows:
        assert row["frames_per_s"] >= row["median_frames_per_s"] > 0.0
