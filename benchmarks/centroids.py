"""Peak finding beside SciPy and NumPy: ``python -m benchmarks.centroids [--device D] [--json]``.

Every line holds one peak over ambient light with noise, which all methods can find; the column
``rms_error_px`` says what their positions are worth.
"""

import argparse
import json
import statistics
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, signal
from scipy.special import ndtr

from compute.signal.finder import CentroidFinder
from compute.signal.noise import LineNoise
from compute.signal.settings import CentroidSettings

Row = dict[str, str | int | float]
Lines = NDArray[np.uint16]
Positions = NDArray[np.float64]

SIZES = ((4, 2048), (32, 2048), (256, 2048), (1000, 2048), (200, 16384))
"""Lines and pixels: 1, 8 and 64 frames of four sensors, then larger batches."""
CUDA_SIZES = (*SIZES, (100_000, 2048))
GAIN, READ_NOISE, OFFSET, AMBIENT, HEIGHT, WIDTH_PX = 10.0, 20.0, 100.0, 20.0, 1000.0, 2.0
LIMIT_COUNTS = 30.0
"""Least height for the peers: twelve times the noise of an empty pixel."""


@dataclass(frozen=True)
class Method:
    """A way to find peaks: its name, and a function that returns each line's position [px]."""

    name: str
    find: Callable[[], Positions]


def measured_lines(lines: int, pixels: int, seed: int = 1) -> tuple[Lines, Positions]:
    """Return noisy lines with one peak each, and the true positions [px]."""
    rng = np.random.default_rng(seed)
    position = rng.uniform(20.0, pixels - 20.0, lines)
    block = rng.normal(
        OFFSET + AMBIENT, np.hypot(READ_NOISE / GAIN, np.sqrt(AMBIENT / GAIN)), (256, pixels)
    )
    # Large batches repeat the noise of 256 lines: drawing all of it would take minutes.
    rows = np.resize(np.rint(block), (lines, pixels)).astype(np.uint16)
    first = position.astype(np.int64) - 12
    edges = first[:, None] + np.arange(26) - 0.5
    mean = np.diff(ndtr((edges - position[:, None]) / WIDTH_PX), axis=1)
    counts = rng.poisson(mean * HEIGHT * WIDTH_PX * np.sqrt(2 * np.pi) * GAIN) / GAIN
    columns = first[:, None] + np.arange(25)
    rows[np.arange(lines)[:, None], columns] += np.rint(counts).astype(np.uint16)
    return rows, position


def by_find_peaks(lines: Lines) -> Positions:
    """scipy.signal.find_peaks on each line, then [4.1] in NumPy around the highest peak."""
    result = np.full(len(lines), np.nan)
    for number, line in enumerate(lines):
        values = line - np.median(line)
        tops, found = signal.find_peaks(values, height=LIMIT_COUNTS)
        if not len(tops):
            continue
        top = int(tops[found["peak_heights"].argmax()])
        below = np.flatnonzero(values <= values[top] / 3)
        split = int(np.searchsorted(below, top))
        left = int(below[split - 1]) + 1 if split else 0
        right = int(below[split]) if split < len(below) else len(values)
        weights = values[left:right] - values[top] / 3
        result[number] = (np.arange(left, right) * weights).sum() / weights.sum()
    return result


def by_ndimage(lines: Lines) -> Positions:
    """scipy.ndimage label and center_of_mass on the whole batch, cut at a third of each maximum."""
    values = lines - np.median(lines, axis=1, keepdims=True)
    cut = np.maximum(values.max(axis=1, keepdims=True) / 3, LIMIT_COUNTS / 3)
    weights = np.maximum(values - cut, 0.0)
    labels, count = ndimage.label(weights > 0, structure=[[0, 0, 0], [1, 1, 1], [0, 0, 0]])
    result = np.full(len(lines), np.nan)
    centres = np.asarray(ndimage.center_of_mass(weights, labels, np.arange(1, count + 1)))
    result[np.rint(centres[:, 0]).astype(np.int64)] = centres[:, 1]
    return result


def by_numpy(lines: Lines) -> Positions:
    """Vectorised NumPy: everything above a third of the line's maximum is one peak."""
    values = lines.astype(np.float32)
    values -= np.median(values[:, ::8], axis=1, keepdims=True)
    weights = values - values.max(axis=1, keepdims=True) / 3
    np.maximum(weights, 0.0, out=weights)
    total = weights.sum(axis=1, dtype=np.float64)
    moment = weights @ np.arange(lines.shape[1], dtype=np.float32)
    positions: Positions = moment / total
    return positions


def run(device: str | None = None, seconds: float = 0.3) -> list[Row]:
    """Time all methods at all sizes, each for about ``seconds``; one row for each.

    Rows have the keys lines, pixels, method, device, time_us (median of a call), gigabytes_per_s
    (of raw counts), times_ours (of ``find``), and, but for the kernel alone, found and
    rms_error_px.
    """
    rows: list[Row] = []
    noise = LineNoise.of(GAIN, READ_NOISE, OFFSET)
    on_cuda = CentroidFinder(1, 64, CentroidSettings(), noise, device).device.startswith("cuda")
    for count, pixels in CUDA_SIZES if on_cuda else SIZES:
        lines, truth = measured_lines(count, pixels)
        finder = CentroidFinder(count, pixels, CentroidSettings(max_peaks=4), noise, device)
        methods = [Method("lumiline find", partial(_first_positions, finder, lines))]
        if count <= 1000:
            methods += [
                Method("vectorised numpy", partial(by_numpy, lines)),
                Method("scipy.ndimage label + center_of_mass", partial(by_ndimage, lines)),
                Method("scipy.signal find_peaks + numpy", partial(by_find_peaks, lines)),
            ]
        ours_us = 0.0
        for method in methods:
            time_us = _median_us(method.find, seconds)
            ours_us = ours_us or time_us
            where = finder.device if method is methods[0] else "cpu"
            row = _row(count, pixels, method.name, where, time_us, ours_us)
            error = method.find() - truth
            found = np.isfinite(error)
            row["found"] = int(found.sum())
            row["rms_error_px"] = float(np.sqrt(np.mean(error[found] ** 2)))
            rows.append(row)
        kernel_us = _kernel_us(finder, count, seconds)
        name = "lumiline kernel alone, lines on the device"
        rows.append(_row(count, pixels, name, finder.device, kernel_us, ours_us))
    return rows


def _first_positions(finder: CentroidFinder, lines: Lines) -> Positions:
    return finder.find(lines).position_px[:, 0]


def _row(lines: int, pixels: int, method: str, device: str, time_us: float, ours_us: float) -> Row:
    return {
        "lines": lines,
        "pixels": pixels,
        "method": method,
        "device": device,
        "time_us": time_us,
        "gigabytes_per_s": lines * pixels * 2 / time_us / 1e3,
        "times_ours": time_us / ours_us,
    }


def _median_us(call: Callable[[], object], seconds: float) -> float:
    """Return the median time of a call [us], after one that does not count."""
    call()
    times: list[int] = []
    while len(times) < 3 or (sum(times) < seconds * 1e9 and len(times) < 10_000):
        start = time.perf_counter_ns()
        call()
        times.append(time.perf_counter_ns() - start)
    return statistics.median(times) / 1e3


def _kernel_us(finder: CentroidFinder, count: int, seconds: float) -> float:
    """Return the time of a launch [us], from launches queued one after another."""
    launches = 50

    def queue() -> None:
        for _ in range(launches):
            finder.launch(count)
        finder.download(1)

    return _median_us(queue, seconds) / launches


def main(argv: Sequence[str] | None = None) -> int:
    """Print the rows as a table, or as JSON."""
    parser = argparse.ArgumentParser(prog="benchmarks.centroids", description=__doc__)
    parser.add_argument("--device", help="cpu, cuda:0, ...; the default is CUDA where there is one")
    parser.add_argument("--seconds", type=float, default=0.3, help="time for each method and size")
    parser.add_argument("--json", action="store_true", help="print JSON")
    options = parser.parse_args(argv)
    rows = run("cuda:0" if options.device == "cuda" else options.device, options.seconds)
    if options.json:
        json.dump(rows, sys.stdout, indent=2)
        print()
        return 0
    print(
        f"{'lines x pixels':>15}  {'method':44} {'us':>11} {'GB/s':>8} {'x ours':>8} {'RMS px':>8}"
    )
    for row in rows:
        size = f"{row['lines']} x {row['pixels']}"
        error = f"{row['rms_error_px']:8.4f}" if "rms_error_px" in row else " " * 8
        print(
            f"{size:>15}  {row['method']:44} {row['time_us']:11.1f} "
            f"{row['gigabytes_per_s']:8.3f} {row['times_ours']:8.2f} {error}"
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
