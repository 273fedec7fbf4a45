"""What becomes a trajectory, and where its gaps are."""

from dataclasses import replace

import numpy as np
import pytest

from compute.errors import InvalidParameter
from compute.tracking.track_batch import TrackState
from service.api.exports.trajectories import trajectories
from tests.service.api.exports.motion_tables import table


def test_labels() -> None:
    """By the marker where only one track is of it; what was never confirmed is none."""
    labels = [one.label for one in trajectories(table())]
    assert labels == [
        "marker-0",
        "track-4",
        "track-7",
        "track-9",
        "probe_origin",
        "probe_tip",
        "ref_origin",
        "ref_tip",
    ]


def test_gaps_where_nothing_was_seen() -> None:
    given = table()
    tracks = given.tracks
    own = tracks.identity == 7
    by_frame = dict(zip(tracks.frame[own].tolist(), np.flatnonzero(own).tolist(), strict=True))
    for predicted, states in (
        (False, (TrackState.CONFIRMED,)),
        (True, (TrackState.CONFIRMED, TrackState.COASTING)),
    ):
        (found,) = [
            one for one in trajectories(given, predicted=predicted) if one.label == "track-7"
        ]
        for frame in range(len(given)):
            row = by_frame.get(frame)
            if row is not None and tracks.state[row] in states:
                assert np.array_equal(found.position_mm[frame], tracks.position_mm[row])
                mean = np.sqrt((tracks.sd_mm[row] ** 2).mean())
                assert found.sd_mm[frame] == pytest.approx(mean)
            else:
                assert np.isnan(found.position_mm[frame]).all()


def test_tools_only_where_their_poses_are_ok() -> None:
    given = table()
    (found,) = [one for one in trajectories(given) if one.label == "ref_tip"]
    own = given.poses.tool == 1
    good = given.poses.status[own] == "OK"
    assert np.array_equal(np.isfinite(found.position_mm).all(axis=1), good)
    assert np.array_equal(found.position_mm[good], given.poses.tip_mm[own][good])


def test_a_tip_that_is_the_origin_is_not_there_twice() -> None:
    given = table()
    given.poses.tip_mm[:] = given.poses.translation_mm
    labels = [one.label for one in trajectories(given)]
    assert "probe_origin" in labels
    assert "probe_tip" not in labels


def test_points_of_strobed_markers() -> None:
    given = table()
    found = trajectories(given, points=True)
    assert found[0].label == "marker-2"
    strobed = given.marker[given.points.frame] == 2
    seen = found[0].position_mm[given.points.frame[strobed]]
    assert np.array_equal(seen, given.points.position_mm[strobed], equal_nan=True)
    assert np.isfinite(found[0].position_mm[:, 0]).sum() == np.isfinite(seen[:, 0]).sum()


def test_nothing_with_a_label() -> None:
    given = table(tools=())
    given.tracks.state[:] = TrackState.TENTATIVE
    with pytest.raises(InvalidParameter, match="no track was confirmed"):
        trajectories(given)
    with pytest.raises(InvalidParameter, match="strobed marker"):
        trajectories(replace(given, marker=np.full(len(given), -1, np.int32)), points=True)
