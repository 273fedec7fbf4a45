"""Case marker-capacity: a small part of it, and how frames are judged."""

from pathlib import Path

import numpy as np
import pytest

import validation.marker_capacity.picture as marker_capacity_picture
from validation.all_cases import ALL_CASES
from validation.marker_capacity.case import CASE, RESOLVED_FRACTION, capacity_of, compute_tables
from validation.marker_capacity.monte_carlo import (
    SCENES,
    Scene,
    Shares,
    capacity,
    expose,
    group,
    owners_of_peaks,
)
from validation.marker_capacity.rigs import RIGS
from validation.progress import progress_listener

pytestmark = pytest.mark.slow


THREE, FOUR, EIGHT = 0, 1, 7


def test_the_case_is_known_with_its_picture() -> None:
    assert ALL_CASES["marker-capacity"].compute_tables is CASE.compute_tables
    assert ALL_CASES["marker-capacity"].picture is not None


@pytest.mark.slow
def test_the_picture_is_drawn(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(marker_capacity_picture, "MARKERS", (1, 2))
    marker_capacity_picture.draw(tmp_path / "capacity.png")
    assert (tmp_path / "capacity.png").read_bytes().startswith(b"\x89PNG")


def test_three_sensors_hold_one_marker_and_four_more() -> None:
    told: list[float] = []
    with progress_listener(lambda share, _: told.append(share)):
        tables, findings = compute_tables((THREE, FOUR, EIGHT), SCENES[:1], (1, 2, 4), 4)
    assert told == sorted(told)
    assert len(told) == 9
    intersections, shares, most = tables
    assert intersections.rows[1][1] == "8"  # [2.15] for two markers, three sensors
    assert [row[0] for row in shares.rows] == ["1", "2", "4"]
    sensors = dict(zip(most.column("configuration"), most.column("sensors"), strict=True))
    assert sensors == {"dainis-1990-three": "3", "dainis-1990-four": "4", "bar, 8 sensors": "8"}
    reached = dict(zip(most.column("configuration"), most.column(SCENES[0].label), strict=True))
    assert reached["dainis-1990-three"] == "1"
    assert reached["bar, 8 sensors"] == "4"
    assert " 0 are wrong" in findings[0]


def test_predictions_resolve_what_three_sensors_cannot() -> None:
    alone = capacity(THREE, SCENES[1], 3, 6)
    assert alone.resolved == 0.0
    assert alone.ambiguous == 1.0
    assert capacity(THREE, SCENES[3], 3, 6).markers > 0.5


def test_frames_have_the_peaks_that_the_scene_says() -> None:
    rig = RIGS[FOUR]()
    rng = np.random.default_rng(1)
    there = stray = 0
    for _ in range(30):
        frame = expose(rig, Scene("", 0.0, missed_fraction=0.2, false=0.1), 10, rng)
        for sensor, line in enumerate(frame.owners):
            place = frame.position_px[sensor, : len(line)]
            assert (np.diff(place) > 0.0).all()
            for at, owner in enumerate(line):
                assert frame.merged[sensor, at] == (len(owner) > 1)
                there += len(owner - {-1})
                stray += -1 in owner
                if owner != {-1} and len(owner) == 1:
                    (marker,) = owner
                    true = rig.cameras.project(frame.places_mm[[marker]])[0, sensor]
                    assert abs(place[at] - true) < 6.0 * rig.sigma_px[sensor]
    assert there == pytest.approx(0.8 * 30 * 40, rel=0.05)
    assert stray == pytest.approx(0.1 * 30 * 40, rel=0.35)


def test_a_group_of_two_markers_peaks_is_wrong() -> None:
    """The judge, beside groups whose peaks are exchanged on purpose."""
    rig, rng = RIGS[EIGHT](), np.random.default_rng(2)
    frame = expose(rig, SCENES[0], 3, rng)
    found = group(rig, SCENES[0], frame, rng)
    assert len(found) == 3
    for choice in found.peaks.tolist():
        assert len(owners_of_peaks(frame, choice)) == 1
    mixed = [int(found.peaks[sensor % 2, sensor]) for sensor in range(8)]
    assert not owners_of_peaks(frame, mixed)
    # One peak of another's is enough.
    almost = [*found.peaks[0, :7].tolist(), int(found.peaks[1, 7])]
    assert not owners_of_peaks(frame, almost)
    assert owners_of_peaks(frame, [*found.peaks[0, :7].tolist(), -1])


def test_what_is_held_ends_at_the_first_number_that_is_not() -> None:
    share = {1: 1.0, 2: RESOLVED_FRACTION, 3: RESOLVED_FRACTION - 0.01, 4: 1.0}
    figures = {
        (0, SCENES[0], count): Shares(resolved, 0.0, 0.0, 0.0, 0, 0)
        for count, resolved in share.items()
    }
    assert capacity_of(figures, 0, SCENES[0], (1, 2, 3, 4)) == 2
