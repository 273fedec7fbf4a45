"""Sections 6.1 and 6.2: the scenes, the figures that judge tracks, and what the cases show."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

import validation.section_6_1.two_active_markers as section_6_1
import validation.section_6_2.three_passive_markers as section_6_2
from compute.tracking.settings import TrackerSettings
from validation.all_cases import ALL_CASES
from validation.result_tables import TablesCase
from validation.section_6.rotating_bar import (
    BAR_MM,
    FRAMES,
    RATE_HZ,
    STILL_FRAMES,
    TURN_S,
    TURNING,
    cameras,
    readings,
    two_active,
)
from validation.section_6.sensor_track_errors import sensor_figures
from validation.section_6.spatial_tracks import SpaceTracks
from validation.section_6_1.kinematics import our_tracks
from validation.section_6_1.thesis_tracking import differences, record
from validation.section_6_1.two_active_markers import (
    COVERED,
    MISSING,
    OURS,
    PREDICTION,
    SHARP,
    VELOCITY,
)
from validation.section_6_2.scene import BACKGROUND_ELECTRONS, SEED, scans
from validation.section_6_2.track_quality import sensor_track_quality, spatial_track_quality
from validation.thesis_tracking.sensor_track import SensorTrack, TrackEnd

pytestmark = pytest.mark.slow


Array = NDArray[np.float64]

SOME = 160
"""Frames, of 350."""


def crossings(position_px: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return the frames after which the difference of two readings (N, 2) changes its sign."""
    side = np.sign(position_px[:, 1] - position_px[:, 0])
    return np.flatnonzero(side[1:] * side[:-1] < 0.0)


def test_the_bar_of_section_6_1() -> None:
    motion = two_active(np.arange(FRAMES) / RATE_HZ)
    between = motion.position_mm[:, 1] - motion.position_mm[:, 0]
    np.testing.assert_allclose(np.linalg.norm(between, axis=1), BAR_MM)
    angle = np.unwrap(np.arctan2(-between[:, 1], -between[:, 0]))
    # 300 frames at 30/s are five turns of 2 s, counter-clockwise, with rest before and after.
    turns = (FRAMES - 2 * STILL_FRAMES) / RATE_HZ / TURN_S
    assert angle[-1] - angle[0] == pytest.approx(2.0 * np.pi * turns)
    assert (angle[: STILL_FRAMES + 1] == angle[0]).all()
    assert (np.abs(np.diff(angle[-STILL_FRAMES:])) < 1e-12).all()
    truth = readings(motion, cameras()).position_px
    for sensor, model in enumerate(cameras()):
        assert len(crossings(truth[:, :, sensor])) == 2 * turns
        assert (truth[:, :, sensor] > 0.0).all()
        assert (truth[:, :, sensor] < model.pixels).all()


def test_velocities_are_those_of_the_positions() -> None:
    fine = 1e-4
    time = np.arange(0.5, 12.0, 0.37)
    before, now, after = (two_active(time + step) for step in (-fine, 0.0, fine))
    velocity = (after.position_mm - before.position_mm) / (2.0 * fine)
    np.testing.assert_allclose(now.velocity_mm_s, velocity, atol=0.5)
    truth = readings(now, cameras())
    moved = (readings(after, cameras()).position_px - readings(before, cameras()).position_px) / (
        2.0 * fine
    )
    np.testing.assert_allclose(truth.velocity_px_s, moved, atol=0.5)
    twice = (
        readings(after, cameras()).position_px
        - 2.0 * truth.position_px
        + readings(before, cameras()).position_px
    ) / fine**2
    even = np.abs(np.gradient(np.linalg.norm(now.velocity_mm_s[:, 0], axis=1))) < 1e-6
    np.testing.assert_allclose(truth.acceleration_px_s2[even], twice[even], atol=3.0)


def waves(scans: int = 121) -> tuple[Array, Array]:
    """Return the positions of two markers that cross, (N, 2), and times."""
    time = np.arange(scans) / RATE_HZ
    wave = 100.0 * np.cos(2.0 * np.pi * time / TURN_S + 0.3)
    return np.column_stack([wave, -wave]), np.full(scans - 1, 1.0 / RATE_HZ)


def test_figures_of_perfect_exchanged_and_spiking_tracks() -> None:
    truth, step = waves()
    moving = differences(truth, step)
    good = sensor_figures(truth, moving, truth, moving)
    assert (good.exchanged, good.spikes, good.right) == (0, 0, 1.0)
    assert good.crossings == 2 * len(crossings(truth)) == 8
    assert good.position_rms == 0.0
    # After the second crossing the tracks are on each other's markers.
    exchanged = truth.copy()
    after = int(crossings(truth)[1]) + 1
    exchanged[after:] = exchanged[after:, ::-1]
    bad = sensor_figures(exchanged, differences(exchanged, step), truth, moving)
    assert bad.exchanged == 2
    assert bad.right == pytest.approx(after / len(truth), abs=0.05)
    # Where it is on the other's, nothing is judged: neither between nor at the crossings.
    assert bad.position_rms == 0.0
    # One wrong point is two wrong velocities, and no exchange.
    spiking = truth.copy()
    spiking[after, 0] += 30.0
    one = sensor_figures(spiking, differences(spiking, step), truth, moving)
    assert (one.exchanged, one.spikes) == (0, 2)
    assert one.position_rms == pytest.approx(np.sqrt(900.0 / truth.size), rel=0.05)


def test_figures_of_tracks_that_end() -> None:
    truth, step = waves()
    ended = truth.copy()
    ended[60:] = np.nan
    moving = differences(truth, step)
    found = sensor_figures(ended, differences(ended, step), truth, moving)
    assert (found.exchanged, found.spikes, found.right) == (0, 0, 1.0)


@pytest.fixture(scope="module")
def short() -> dict[str, dict[str, section_6_1.SensorFigures]]:
    return {
        scene.name: section_6_1.along_sensors(replace(scene, frames=SOME))
        for scene in (SHARP, COVERED, MISSING)
    }


def test_the_thesis_keeps_identity_with_spikes_where_lines_are_sharp(
    short: dict[str, dict[str, section_6_1.SensorFigures]],
) -> None:
    found = short[SHARP.name]
    assert found[VELOCITY].crossings >= 24
    assert found[VELOCITY].exchanged == 0
    assert found[VELOCITY].right == 1.0
    assert found[VELOCITY].spikes > 0
    assert found[PREDICTION].exchanged == 0
    assert found[PREDICTION].spikes < found[VELOCITY].spikes


def test_ours_keeps_identity_through_every_crossing_without_spikes(
    short: dict[str, dict[str, section_6_1.SensorFigures]],
) -> None:
    for name, found in short.items():
        assert found[OURS].exchanged == 0, name
        assert found[OURS].right == 1.0, name
        assert found[OURS].spikes == 0, name
        for figure in ("position_rms", "velocity_rms", "acceleration_rms"):
            assert getattr(found[OURS], figure) < 0.5 * getattr(found[VELOCITY], figure), name
    for scene in (SHARP, COVERED, MISSING):
        assert our_tracks(replace(scene, frames=SOME)).switches == 0


def test_gaps_at_crossings_cost_the_thesis_identities(
    short: dict[str, dict[str, section_6_1.SensorFigures]],
) -> None:
    for scene in (COVERED, MISSING):
        assert short[scene.name][VELOCITY].exchanged > 0
        assert short[scene.name][VELOCITY].exchanged > short[scene.name][PREDICTION].exchanged


def test_missing_peaks_are_as_many_as_assumed() -> None:
    seen = record(replace(MISSING, frames=SOME))
    sharp = record(replace(SHARP, frames=SOME))
    for scene, most in ((seen, 40), (sharp, 15)):
        alone = [(~np.isnan(points)).sum(axis=1)[TURNING] < 2 for points in scene.points_px]
        assert 0 < sum(int(one.sum()) for one in alone[1:]) < 3 * most


@pytest.mark.slow
def test_case_6_1_and_its_picture(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scenes = tuple(replace(scene, frames=SOME) for scene in (SHARP, COVERED, MISSING))
    for name, scene in zip(("SHARP", "COVERED", "MISSING"), scenes, strict=True):
        monkeypatch.setattr(section_6_1, name, scene)
    monkeypatch.setattr(section_6_1, "SCENES", scenes)
    tables, findings = section_6_1.compute_tables()
    assert [len(table.rows) for table in tables] == [9, 9, 3, 18, 18]
    assert len(findings) == 6
    live = {tuple(map(str, row[:2])): row for row in tables[-1].rows}
    exchanged, lost = (tables[-1].headings.index(name) for name in ("exchanged", "lost"))
    for scene in scenes:
        for method in ("window, by prediction", "eight-state", "readings"):
            assert live[scene.name, method][exchanged] == 0.0
            # At rest sensor 1 sees the markers one behind the other.
            assert float(str(live[scene.name, method][lost])) * SOME < STILL_FRAMES + 20
    assert float(str(live[SHARP.name, "probabilistic"][exchanged])) > 0.0
    case = ALL_CASES["section-6.1"]
    assert isinstance(case, TablesCase)
    assert case.picture is not None
    case.picture(tmp_path / "section.png")
    assert (tmp_path / "section.png").read_bytes().startswith(b"\x89PNG")


def test_the_scene_of_section_6_2() -> None:
    seen = scans(SEED, 60)
    dark = np.concatenate([lines[:, :40].ravel() for lines in seen.lines]).astype(np.float64)
    assert dark.mean() == pytest.approx(BACKGROUND_ELECTRONS, rel=0.001)
    highest = max(float(lines.max()) for lines in seen.lines)
    # [3.29]: 1.035 at most where one marker stands, and two may meet.
    assert 1.035 < highest / BACKGROUND_ELECTRONS < 1.09


def constant(position: float, scans: int, first: int = 0, number: int = 0) -> SensorTrack:
    seen = np.ones(scans, dtype=np.bool_)
    return SensorTrack(number, first, np.full(scans, position), seen, ~seen, TrackEnd.RUNNING)


def test_hold_of_known_tracks() -> None:
    truth = np.broadcast_to(np.array([100.0, 200.0])[:, None], (50, 2, 1))
    whole = [constant(100.0, 50), constant(200.0, 50, number=1)]
    good = sensor_track_quality([whole], truth)
    # A track is none before it is old.
    assert (good.right, good.lost) == (pytest.approx(0.96), pytest.approx(0.04))
    assert (good.first, good.wrong, good.exchanged, good.false) == (good.right, 0.0, 0.0, 0.0)
    broken = [constant(100.0, 50), constant(200.0, 20, number=1), constant(200.0, 30, 20, 2)]
    found = sensor_track_quality([broken], truth)
    assert found.exchanged == 0.5
    assert found.first == pytest.approx((48 + 18) / 100)
    assert found.right == pytest.approx((48 + 18 + 28) / 100)
    # A track that goes from one marker to the other is wrong there.
    jumping = replace(whole[0], position_px=np.repeat([100.0, 200.0], 25))
    found = sensor_track_quality([[jumping]], truth)
    assert found.right == pytest.approx(23 / 100)
    assert found.wrong == pytest.approx(25 / 100)
    false = [*whole, constant(400.0, 1, 7, 2), constant(420.0, 5, 9, 3)]
    found = sensor_track_quality([false], truth)
    assert (found.false, found.false_life, found.false_old) == (2.0, 3.0, 1.0)


def test_hold_in_space_of_known_tracks() -> None:
    identity = np.array([[1, 2], [1, 2], [1, 2], [2, 1], [3, 1], [0, 1]])
    nothing = np.full((6, 2, 3), np.nan)
    found = spatial_track_quality(
        SpaceTracks(
            identity, nothing, nothing, nothing, np.array([0, 1, 1, 0, 0, 0]), frozenset({9})
        )
    )
    assert found.lost == pytest.approx(1 / 12)
    assert found.right == pytest.approx(7 / 12)  # track 3 began at the first marker
    assert found.wrong == pytest.approx(4 / 12)
    assert found.first == pytest.approx(6 / 12)
    assert found.exchanged == 1.5
    assert (found.false, found.false_life) == (1.0, 2.0)


@pytest.mark.slow
def test_case_6_2(monkeypatch: pytest.MonkeyPatch) -> None:
    tables, findings = section_6_2.compute_tables((SEED,), 60)
    detected = {str(row[0]): row[1:] for row in tables[0].rows}
    before, after = detected[section_6_2.BEFORE], detected[section_6_2.AFTER]
    # [6.5] takes nine of ten false peaks away, and hardly a marker.
    assert float(str(after[1])) < 0.15 * float(str(before[1]))
    assert float(str(after[0])) > float(str(before[0])) - 0.05
    tracked = {str(row[0]): row for row in tables[1].rows}
    columns = tables[1].headings
    exchanged, old = columns.index("exchanged"), columns.index("grew old")
    thesis, ours = tracked["thesis, after [6.5]"], tracked["ours"]
    assert float(str(thesis[exchanged])) > 1.0
    assert ours[exchanged] == 0.0
    # A track of a faint marker is confirmed within two thirds of a second, 20 scans, and kept.
    assert (1.0 - float(str(ours[1]))) * 60 < 20
    assert float(str(ours[columns.index("wrong")])) == 0.0
    # False targets live longer where there are many.
    assert float(str(tracked["thesis, before [6.5]"][old])) > 3.0 * float(str(thesis[old]))
    assert len(findings) == 8
    live = {str(row[1]): row for row in tables[-1].rows}
    assert set(live) == {"probabilistic", "probabilistic, curve, 5 px", "eight-state", "readings"}
    lost = tables[-1].headings.index("lost")
    assert float(str(live["eight-state"][lost])) < float(str(live["probabilistic"][lost]))


def test_picture_6_2(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import validation.section_6_2.picture as section_6_2_picture

    def few(kind: str, seed: int) -> tuple[Array, ...]:
        return section_6_2.points(kind, seed, 60)

    def tracks(settings: TrackerSettings, seed: int) -> SpaceTracks:
        return section_6_2.our_tracks(settings, seed, 60)

    monkeypatch.setattr(section_6_2_picture, "points", few)
    monkeypatch.setattr(section_6_2_picture, "our_tracks", tracks)
    section_6_2_picture.draw(tmp_path / "section.png")
    assert (tmp_path / "section.png").read_bytes().startswith(b"\x89PNG")
