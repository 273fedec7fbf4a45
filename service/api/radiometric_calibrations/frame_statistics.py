"""Statistics of the pixels of a device's sensors over dark or flat frames, which are not kept."""

import io
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.signal.capture_statistics import CaptureAccumulator, CaptureStatistics

_FIELDS: Final = tuple(field.name for field in fields(CaptureStatistics))


@dataclass(frozen=True, eq=False)
class FrameStatistics:
    """Statistics of frames of one unchanging scene.

    Args:
        sensors: of the pixels of each of the S sensors.
        flicker: standard deviation of each sensor's mean count from frame to frame, relative to
            that mean, shape (S,).
    """

    sensors: tuple[CaptureStatistics, ...]
    flicker: NDArray[np.float64]

    @property
    def frames(self) -> int:
        """Number of frames."""
        return self.sensors[0].frames


class FrameAccumulator:
    """Takes frames of S sensors as they come and keeps sums, not frames.

    Args:
        sensors: S.
    """

    def __init__(self, sensors: int) -> None:
        self._sensors = tuple(CaptureAccumulator() for _ in range(sensors))
        self._levels: list[NDArray[np.float64]] = []

    @property
    def frames(self) -> int:
        """Number of frames so far."""
        return len(self._levels)

    def add(self, lines: NDArray[np.uint16]) -> None:
        """Take the scans of the next frame, shape (S, P)."""
        for accumulator, line in zip(self._sensors, lines, strict=True):
            accumulator.add(line[None])
        self._levels.append(lines.mean(axis=1))

    def statistics(self) -> FrameStatistics:
        """Return the statistics of the frames so far, at least one."""
        levels = np.array(self._levels)
        flicker = levels.std(axis=0) / np.maximum(levels.mean(axis=0), 1.0)
        return FrameStatistics(tuple(one.statistics() for one in self._sensors), flicker)


def statistics_of(frames: Iterable[NDArray[np.uint16]], sensors: int) -> FrameStatistics:
    """Return the statistics of frames, each of shape (S, P), of at least one."""
    sums = FrameAccumulator(sensors)
    for lines in frames:
        sums.add(lines)
    return sums.statistics()


def pack_statistics(found: Mapping[str, FrameStatistics]) -> bytes:
    """Return statistics by name as a NumPy archive."""
    arrays = {f"{name}/flicker": one.flicker for name, one in found.items()} | {
        f"{name}/{field}": np.array([getattr(sensor, field) for sensor in one.sensors])
        for name, one in found.items()
        for field in _FIELDS
    }
    with io.BytesIO() as file:
        np.savez_compressed(file, **arrays)
        return file.getvalue()


def unpack_statistics(data: bytes) -> dict[str, FrameStatistics]:
    """Return the statistics of an archive by name; none of an empty one."""
    if not data:
        return {}
    found = {}
    with np.load(io.BytesIO(data), allow_pickle=False) as arrays:
        for name in dict.fromkeys(key.rpartition("/")[0] for key in arrays.files):
            columns = {field: arrays[f"{name}/{field}"] for field in _FIELDS}
            frames = columns.pop("frames").tolist()
            found[name] = FrameStatistics(
                tuple(
                    CaptureStatistics(
                        count, **{field: rows[number] for field, rows in columns.items()}
                    )
                    for number, count in enumerate(frames)
                ),
                arrays[f"{name}/flicker"],
            )
    return found
