"""Readers of text formats, written after their descriptions and strict about them."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def read_trc(path: Path) -> tuple[dict[str, str], list[str], Array, Array, Array]:
    """Return facts, labels, frame numbers, times [s] and positions (frames, labels, 3).

    After the description of OpenSim: line 1 begins with PathFileType; lines 2 and 3 are names and
    values; line 4 is Frame#, Time and each label in the first of its three columns; line 5 has the
    coordinates' labels X1 Y1 Z1 X2 ...; line 6 is empty; then a row for each frame.
    """
    lines = path.read_text(encoding="utf-8").split("\n")
    assert lines.pop() == ""
    first = lines[0].split("\t")
    assert first[:3] == ["PathFileType", "4", "(X/Y/Z)"]
    assert first[3] == path.name
    names, values = lines[1].split("\t"), lines[2].split("\t")
    facts = dict(zip(names, values, strict=True))
    labels = lines[3].split("\t")
    assert labels[:2] == ["Frame#", "Time"]
    markers = labels[2::3]
    assert labels[3::3] == labels[4::3] == [""] * len(markers)
    assert all(markers)
    assert not any(" " in marker for marker in markers)
    coordinates = [f"{axis}{one}" for one in range(1, len(markers) + 1) for axis in "XYZ"]
    assert lines[4].split("\t") == ["", "", *coordinates]
    assert lines[5] == ""
    rows = [line.split("\t") for line in lines[6:]]
    assert {len(row) for row in rows} <= {2 + 3 * len(markers)}
    assert int(facts["NumFrames"]) == len(rows)
    assert int(facts["NumMarkers"]) == len(markers)
    numbers = np.array([int(row[0]) for row in rows], np.float64)
    assert (np.diff(numbers) > 0).all()
    times = np.array([float(row[1]) for row in rows])
    cells = [[float(cell) if cell else np.nan for cell in row[2:]] for row in rows]
    return facts, markers, numbers, times, np.array(cells).reshape(len(rows), -1, 3)


def read_sequence(path: Path) -> tuple[dict[str, str], list[dict[str, str]]]:
    """Return the fields of a sequence metafile, and those of each of its frames.

    As IGSIO reads it: lines ``name = value`` of less than 1000 characters; those of frames are
    ``Seq_FrameNNNN_name``; ``ElementDataFile`` is the last.
    """
    lines = path.read_text(encoding="ascii").split("\n")
    assert lines.pop() == ""
    assert lines[0] == "ObjectType = Image"
    assert lines[-1] == "ElementDataFile = LOCAL"
    fields: dict[str, str] = {}
    frames: list[dict[str, str]] = []
    for line in lines:
        assert len(line) < 1000
        name, equals, value = line.partition(" = ")
        assert equals
        if not name.startswith("Seq_Frame"):
            assert name not in fields
            fields[name] = value
            continue
        number, _, own = name.removeprefix("Seq_Frame").partition("_")
        assert len(number) >= 4
        if int(number) == len(frames):
            frames.append({})
        assert int(number) == len(frames) - 1
        assert own not in frames[-1]
        frames[-1][own] = value
    assert int(fields["NDims"]) == 3
    *size, count = map(int, fields["DimSize"].split())
    assert size == [0, 0]
    assert count == len(frames)
    assert fields["Kinds"].split()[-1] in ("list", "time")
    return fields, frames


def matrix(text: str) -> Any:
    """Return a transform of 16 numbers, row by row."""
    return np.array([float(number) for number in text.split()]).reshape(4, 4)
