"""Tools out of a file."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from compute.errors import DegenerateTool, IndistinguishableTools, InvalidParameter
from service.cli.tracking_files import read_tools

MARKERS = [[0.0, 0.0, 0.0], [60.0, 0.0, 0.0], [0.0, 80.0, 10.0], [-40.0, 30.0, 50.0]]


def file(tmp_path: Path, content: Any) -> Path:
    path = tmp_path / "tools.json"
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


def test_as_rest_takes_and_sends_them(tmp_path: Path) -> None:
    taken = {"id": "probe", "markers_mm": MARKERS, "strobe_markers": [0, 1, 2, 5], "note": "x"}
    sent = {
        "items": [
            taken | {"tip": {"position_mm": [0, 0, -100], "axis": None}, "device_id": "bar"},
            {
                "id": "ref",
                "markers_mm": MARKERS,
                "strobe_markers": [6, 7, 8, 9],
                "tip_mm": [1, 2, 3],
            },
        ],
        "total": 2,
    }
    (alone,) = read_tools(file(tmp_path, [taken]))
    assert (alone.name, alone.strobe_markers, alone.tip_mm) == ("probe", (0, 1, 2, 5), None)
    assert np.array_equal(alone.markers_mm, MARKERS)
    probe, ref = read_tools(file(tmp_path, sent))
    assert probe.tip_mm == (0.0, 0.0, -100.0)
    assert ref.tip_mm == (1.0, 2.0, 3.0)


def test_limits_and_devices_count(tmp_path: Path) -> None:
    strict = {"id": "probe", "markers_mm": MARKERS, "strobe_markers": [0, 1, 2, 5]} | {
        "limits": {"tip_sd_mm": 0.25}, "device_id": "bar"
    }  # fmt: skip
    other = {"id": "ref", "markers_mm": MARKERS, "limits": {"tip_sd_mm": None}, "device_id": "sim"}
    path = file(tmp_path, [strict, other | {"strobe_markers": [6, 7, 8, 9]}])
    probe, ref = read_tools(path)
    assert (probe.max_tip_sd_mm, ref.max_tip_sd_mm) == (0.25, None)
    assert [one.name for one in read_tools(path, "bar")] == ["probe"]
    with pytest.raises(InvalidParameter, match="tip_sd_mm"):
        read_tools(file(tmp_path, [strict | {"limits": {"tip_sd_mm": -1}}]))


@pytest.mark.parametrize(
    ("content", "error", "words"),
    [
        ("{", InvalidParameter, "not JSON"),
        ("[" * 100_000, InvalidParameter, "not JSON"),
        ({"id": "probe"}, InvalidParameter, "holds no tools"),
        ([{"id": "a To b", "markers_mm": MARKERS}], InvalidParameter, "id"),
        ([{"id": "probe", "markers_mm": [[0, 0]]}], InvalidParameter, "markers_mm"),
        ([{"id": "probe", "markers_mm": MARKERS, "strobe_markers": [1]}], InvalidParameter, "each"),
        ([{"id": "probe", "markers_mm": MARKERS}] * 2, InvalidParameter, "one name"),
        ([{"id": "probe", "markers_mm": MARKERS[:2]}], DegenerateTool, "markers"),
        (
            [{"id": "probe", "markers_mm": MARKERS}, {"id": "ref", "markers_mm": MARKERS}],
            IndistinguishableTools,
            "look alike",
        ),
    ],
)
def test_what_is_refused(tmp_path: Path, content: Any, error: type[Exception], words: str) -> None:
    with pytest.raises(error, match=words):
        read_tools(file(tmp_path, content))


def test_no_file(tmp_path: Path) -> None:
    with pytest.raises(InvalidParameter, match="cannot be read"):
        read_tools(tmp_path / "none.json")
