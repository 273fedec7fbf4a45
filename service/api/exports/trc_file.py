"""TRC (track row column): trajectories as tab-separated text; blank cells are gaps.

As OpenSim describes it: two rows of facts' names and values behind the file's own line, two rows of
labels, an empty one, then one row for each frame.
"""

from collections.abc import Sequence
from pathlib import Path

from service.api.exports.motion_table import MotionTable
from service.api.exports.trajectories import Trajectory


def write_trc(table: MotionTable, found: Sequence[Trajectory], path: Path) -> None:
    """Write trajectories; frames are numbered from 1, those that were lost are left out.

    Times are those of the exposures on the device's clock since the first.
    """
    numbers = (table.sequence - table.sequence[:1] + 1).tolist()
    facts = {
        "DataRate": f"{table.rate_hz:.6g}",
        "CameraRate": f"{table.rate_hz:.6g}",
        "NumFrames": len(table),
        "NumMarkers": len(found),
        "Units": "mm",
        "OrigDataRate": f"{table.rate_hz:.6g}",
        "OrigDataStartFrame": 1,
        "OrigNumFrames": numbers[-1] if numbers else 0,
    }
    head = [
        ["PathFileType", "4", "(X/Y/Z)", path.name],
        list(facts),
        [str(value) for value in facts.values()],
        ["Frame#", "Time", *(cell for one in found for cell in (one.label, "", ""))],
        ["", "", *(f"{axis}{place}" for place in range(1, len(found) + 1) for axis in "XYZ")],
        [],
    ]
    places = [one.position_mm for one in found]
    with path.open("w", encoding="utf-8", newline="") as file:
        for row in head:
            file.write("\t".join(row) + "\n")
        for index, (number, time_s) in enumerate(zip(numbers, table.time_s.tolist(), strict=True)):
            cells = [_cell(value) for place in places for value in place[index].tolist()]
            file.write("\t".join([str(number), f"{time_s:.9f}", *cells]) + "\n")


def _cell(value: float) -> str:
    return f"{value:.6f}" if value == value else ""
