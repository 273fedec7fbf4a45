"""Benchmark of peak detection against array code: ``python -m benchmarks.signal``.

Three tables: *throughput* (raw counts in memory to peaks), *latency* (one frame of 4 x 2048
pixels from the host's memory to peaks in the host's memory) and, on the CPU, what the positions
are worth. The peers find one peak a line, whatever the line holds; ours find all.
"""

import argparse
import json
import statistics
import sys
import time
from collections.abc import Callable, Sequence
from functools import partial

import numpy as np

from benchmarks.signal_peers import by_find_peaks, by_numpy, numba_method
from benchmarks.synthetic_scans import NOISE, WIDTH_PX, Lines, Positions, measured_lines
from compute.signal.centroid_finder import CentroidFinder
from compute.signal.centroid_settings import CentroidSettings
from compute.signal.fit.fit_finder import FitFinder
from compute.signal.fit.fit_settings import FitSettings
from compute.signal.peak_finder import PeakFinder
from compute.signal.pixel_corrections import PixelCorrections

Row = dict[str, str | int | float]

CPU_SIZES = ((1000, 2048), (20_000, 2048), (20_000, 128), (2000, 16_384))
CUDA_SIZES = ((262_144, 2048), (1_048_576, 128), (32_768, 16_384))
FIT_LINES = 1000
CUDA_FIT_LINES = 524_288
"""A few lines in ten thousand look like two peaks and take long: enough others beside them."""
PEAKS = 8
FRAME = (4, 2048)


def centroid_finder(
    count: int, pixels: int, device: str | None, corrections: PixelCorrections | None = None
) -> CentroidFinder:
    """Return a centroid finder with capacity for all peaks of the scans."""
    settings = CentroidSettings(max_peaks=PEAKS)
    return CentroidFinder(count, pixels, settings, NOISE, device, corrections=corrections)


def fit_finder(
    count: int,
    pixels: int,
    device: str | None,
    width_log_sigma: float,
    corrections: PixelCorrections | None = None,
) -> FitFinder:
    """Return a finder that fits the line spread function, of known or unknown width."""
    search = CentroidSettings(max_peaks=PEAKS, min_width_px=1)
    settings = FitSettings(search, WIDTH_PX, width_log_sigma)
    return FitFinder(count, pixels, settings, NOISE, device=device, corrections=corrections)


def even_corrections(pixels: int) -> PixelCorrections:
    """Return corrections of a sensor of even response, with which the same peaks are found."""
    offset = np.array([float(NOISE.offset_counts[0])], np.float32)
    return PixelCorrections(
        np.full((1, pixels), offset[0], np.float32),
        np.ones((1, pixels), np.float32),
        offset,
        np.zeros((1, 2), np.float32),
    )


def throughput(device: str | None = None, seconds: float = 0.3) -> list[Row]:
    """Time all methods on large batches in device memory.

    Rows have the keys lines, pixels, peaks, method, time_us, million_lines_per_s,
    million_peaks_per_s, gigabytes_per_s (of raw counts), share_of_copy (of the bandwidth of a
    copy, or on the CPU of reading), times_ours (the time over that of our centre of gravity) and
    times_copy (over that of reading each pixel once at that bandwidth: more than this nobody can
    be faster).
    """
    on_cuda = centroid_finder(1, 64, device).device.startswith("cuda")
    limit = _copy_bytes_per_s() if on_cuda else read_bytes_per_s()
    rows: list[Row] = []
    for count, pixels in CUDA_SIZES if on_cuda else CPU_SIZES:
        for peaks in (PEAKS if pixels >= 512 else 2, 1):
            lines = batch(count, pixels, peaks)
            finder = centroid_finder(count, pixels, device)
            finder.upload(lines)
            ours_us = queued_us(finder, count, seconds)
            row = partial(_row, count, pixels, peaks, limit, ours_us)
            rows.append(row("lumiline", ours_us))
            if peaks == 1 and pixels == 2048:
                peers = _cuda_peers(lines, seconds) if on_cuda else _cpu_peers(lines, seconds)
                rows += [row(name, time_us) for name, time_us in peers]
    return rows + _fits(CUDA_FIT_LINES if on_cuda else FIT_LINES, device, limit, seconds)


def _fits(count: int, device: str | None, limit: float, seconds: float) -> list[Row]:
    rows: list[Row] = []
    for peaks in (PEAKS, 1):
        lines = batch(count, FRAME[1], peaks)
        centroid = centroid_finder(count, FRAME[1], device)
        centroid.upload(lines)
        ours_us = queued_us(centroid, count, seconds)
        del centroid
        row = partial(_row, count, FRAME[1], peaks, limit, ours_us)
        known = even_corrections(FRAME[1])
        calibrated = centroid_finder(count, FRAME[1], device, known)
        calibrated.upload(lines)
        rows.append(row("lumiline, calibrated pixels", queued_us(calibrated, count, seconds)))
        del calibrated
        for name, spread, corrections in (
            ("width fitted", 0.5, None),
            ("width fitted, calibrated pixels", 0.5, known),
            ("width known", 0.0, None),
            ("width known, calibrated pixels", 0.0, known),
        ):
            finder = fit_finder(count, FRAME[1], device, spread, corrections)
            finder.upload(lines)
            rows.append(row(f"lumiline fit, {name}", queued_us(finder, count, seconds)))
    return rows


def batch(count: int, pixels: int, peaks: int) -> Lines:
    """Return scans for timing; large batches repeat 4096 different ones."""
    block = measured_lines(min(count, 4096), pixels, peaks)[0]
    return block if count <= 4096 else np.resize(block, (count, pixels))


def latency(device: str | None = None, frames: int = 5000) -> list[Row]:
    """Time single frames, host to host; rows with method, median_us and p99_us."""
    lines, _ = measured_lines(*FRAME)
    finder = centroid_finder(*FRAME, device)

    def cyclic() -> None:
        finder.upload(lines)
        finder.launch(len(lines))
        finder.download(len(lines))

    fits = fit_finder(*FRAME, device, 0.5)
    found: list[tuple[str, Callable[[], object]]] = [
        (f"lumiline on {finder.device}", partial(finder.find, lines)),
        (f"lumiline fit on {finder.device}", partial(fits.find, lines)),
    ]
    if finder.device.startswith("cuda"):
        found.append(("lumiline, copy, launch, copy in turn", cyclic))
    parallel = numba_method()
    if parallel is not None:
        found.append(("numba, parallel, on the CPU", partial(parallel, lines)))
    found.append(("vectorised NumPy", partial(by_numpy, lines)))
    return [_latency_row(name, call, frames) for name, call in found]


def accuracy() -> list[Row]:
    """Accuracy of the methods: rows with method, found and rms_error_px."""
    lines, truth = measured_lines(1000, 2048)
    finder = centroid_finder(1000, 2048, "cpu")
    fits = fit_finder(1000, 2048, "cpu", 0.5)
    methods: list[tuple[str, Callable[[Lines], Positions]]] = [
        ("lumiline", lambda rows: finder.find(rows).position_px[:, 0]),
        ("lumiline fit", lambda rows: fits.find(rows).position_px[:, 0]),
        ("scipy.signal find_peaks + NumPy", by_find_peaks),
        ("vectorised NumPy", by_numpy),
    ]
    parallel = numba_method()
    if parallel is not None:
        methods.append(("numba, parallel", parallel))
    rows: list[Row] = []
    for name, method in methods:
        error = method(lines) - truth[:, 0]
        found = np.isfinite(error)
        rms = float(np.sqrt(np.mean(error[found] ** 2)))
        rows.append({"method": name, "found": int(found.sum()), "rms_error_px": rms})
    return rows


def read_bytes_per_s(megabytes: int = 256, repeats: int = 7) -> float:
    """Return the bandwidth at which all CPUs together read memory [B/s], by sums in threads."""
    from concurrent.futures import ThreadPoolExecutor
    from os import sched_getaffinity

    threads = len(sched_getaffinity(0))
    parts = np.ones(megabytes * 2**20 // 8, np.uint64).reshape(threads, -1)
    with ThreadPoolExecutor(threads) as pool:
        # The sum of unsigned integers is vectorised and lets other threads run.
        best = min(
            _seconds(lambda: list(pool.map(lambda part: part.sum(), parts))) for _ in range(repeats)
        )
    return parts.nbytes / best


def queued_us(finder: PeakFinder, count: int, seconds: float) -> float:
    """Return the time of a launch [us], from launches queued one after another."""
    launches = 20

    def queue() -> None:
        for _ in range(launches):
            finder.launch(count)
        finder.download(1)

    return median_us(queue, seconds) / launches


def median_us(call: Callable[[], object], seconds: float) -> float:
    """Return the median time of a call [us], after a warm-up call."""
    call()
    times: list[float] = []
    while len(times) < 3 or (sum(times) < seconds and len(times) < 10_000):
        times.append(_seconds(call))
    return 1e6 * statistics.median(times)


def _seconds(call: Callable[[], object]) -> float:
    start = time.perf_counter_ns()
    call()
    return (time.perf_counter_ns() - start) * 1e-9


def _cpu_peers(lines: Lines, seconds: float) -> list[tuple[str, float]]:
    parallel = numba_method()
    found = [
        ("vectorised NumPy", partial(by_numpy, lines)),
        ("scipy.signal find_peaks + NumPy", partial(by_find_peaks, lines)),
    ]
    if parallel is not None:
        found.insert(0, ("numba, parallel", partial(parallel, lines)))
    return [(name, median_us(call, seconds)) for name, call in found]


def _cuda_peers(lines: Lines, seconds: float) -> list[tuple[str, float]]:
    from benchmarks.signal_cuda_peers import cupy_peers, synchronize, torch_peers

    found: list[tuple[str, float]] = []
    for make in (cupy_peers, torch_peers):
        for name, call in make(lines):

            def repeat(call: Callable[[], object] = call) -> None:
                for _ in range(5):
                    call()
                synchronize()

            found.append((name, median_us(repeat, seconds) / 5))
    return found


def _copy_bytes_per_s() -> float:
    from benchmarks.signal_cuda_peers import copy_bytes_per_s

    return copy_bytes_per_s()


def _row(
    count: int,
    pixels: int,
    peaks: int,
    limit: float,
    ours_us: float,
    method: str,
    time_us: float,
) -> Row:
    rate = count * pixels * 2 / time_us * 1e6
    return {
        "lines": count,
        "pixels": pixels,
        "peaks": peaks,
        "method": method,
        "time_us": time_us,
        "million_lines_per_s": count / time_us,
        "million_peaks_per_s": count * peaks / time_us if method.startswith("lumiline") else "",
        "gigabytes_per_s": rate * 1e-9,
        "share_of_copy": rate / limit,
        "times_ours": time_us / ours_us,
        "times_copy": limit / rate,
    }


def _latency_row(name: str, call: Callable[[], object], frames: int) -> Row:
    call()
    times = np.array([_seconds(call) for _ in range(frames)]) * 1e6
    median, p99 = np.percentile(times, [50.0, 99.0])
    return {"method": name, "median_us": float(median), "p99_us": float(p99)}


def print_rows(title: str, rows: Sequence[Row]) -> None:
    """Print rows of the same keys as a table."""
    print(title)
    if not rows:
        return
    cells = [
        [f"{value:.4g}" if isinstance(value, float) else str(value) for value in row.values()]
        for row in rows
    ]
    table = [list(rows[0]), *cells]
    widths = [max(len(line[k]) for line in table) for k in range(len(table[0]))]
    for line in table:
        print("  " + "  ".join(text.rjust(width) for text, width in zip(line, widths, strict=True)))
    print()


def main(argv: Sequence[str] | None = None) -> int:
    """Print the tables, or all as JSON."""
    parser = argparse.ArgumentParser(prog="benchmarks.signal", description=__doc__)
    parser.add_argument("--device", help="cpu, cuda:0, ...; the default is CUDA where there is one")
    parser.add_argument("--seconds", type=float, default=0.3, help="time for each method and size")
    parser.add_argument("--json", action="store_true", help="print JSON")
    options = parser.parse_args(argv)
    device = "cuda:0" if options.device == "cuda" else options.device
    tables = {
        "throughput": throughput(device, options.seconds),
        "latency": latency(device),
        # The kernels on the CPU are not there on every machine with CUDA.
        "accuracy": [] if centroid_finder(1, 64, device).device != "cpu" else accuracy(),
    }
    if options.json:
        json.dump(tables, sys.stdout, indent=2)
        print()
        return 0
    for title, rows in tables.items():
        print_rows(title, rows)
    return 0


if __name__ == "__main__":
    sys.exit(main())
