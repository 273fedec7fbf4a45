"""Agreement of CPU and CUDA peak detection in a million random scans.

``python -m benchmarks.cpu_cuda_agreement --write FILE`` works them out on the CPU;
``--compare FILE --device cuda:0``, there or on another machine, says how far its own are from
them. The lines come from a seed: single, double and faint peaks, saturated ones, peaks at the
ends, spikes, lines of random bits, of one value, and of noise.
"""

import argparse
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from compute.signal.centroid_finder import CentroidFinder
from compute.signal.centroid_settings import CentroidSettings
from compute.signal.fit.fit_finder import FitFinder
from compute.signal.fit.fit_settings import FitSettings
from compute.signal.peaks import PeakBatch
from compute.signal.sensor_noise import SensorNoise

LINES, BLOCK, PIXELS, ROOM = 1_000_000, 20_000, 128, 4
GAIN, READ, OFFSET, FULL = 8.0, 16.0, 60.0, 4095
NOISE = SensorNoise.of(GAIN, READ, OFFSET, FULL)


def random_lines(seed: int, count: int) -> NDArray[np.uint16]:
    """Return random scans of every kind, uint16, shape (``count``, PIXELS)."""
    rng = np.random.default_rng(seed)
    edges = np.arange(PIXELS + 1) - 0.5
    counts = np.full((count, PIXELS), 12.0)
    for probability in (0.9, 0.5):
        position = rng.uniform(-3.0, PIXELS + 3.0, count)
        width = rng.uniform(0.5, 3.0, count)
        light = np.where(rng.random(count) < probability, 10.0 ** rng.uniform(1.5, 4.5, count), 0.0)
        share = np.diff(ndtr((edges - position[:, None]) / width[:, None]), axis=1)
        counts += light[:, None] * share
    electrons = rng.poisson(counts * GAIN) + rng.normal(0.0, READ, counts.shape)
    lines = np.clip(np.rint(electrons / GAIN + OFFSET), 0, FULL).astype(np.uint16)
    kind = rng.random(count)
    bits = kind < 0.02
    lines[bits] = rng.integers(0, 65536, (int(bits.sum()), PIXELS))
    flat = (kind >= 0.02) & (kind < 0.03)
    lines[flat] = rng.choice([0, 60, FULL, 65535], (int(flat.sum()), 1))
    spiked = np.flatnonzero((kind >= 0.03) & (kind < 0.05))
    lines[spiked, rng.integers(0, PIXELS, len(spiked))] = FULL
    return lines


def both(device: str) -> Iterator[tuple[str, PeakBatch]]:
    """Yield the peaks of both methods in blocks of the million scans."""
    centroid = CentroidFinder(BLOCK, PIXELS, CentroidSettings(max_peaks=ROOM), NOISE, device)
    search = CentroidSettings(max_peaks=ROOM, min_width_px=1)
    fit = FitFinder(BLOCK, PIXELS, FitSettings(search, 1.2), NOISE, device=device)
    for seed in range(LINES // BLOCK):
        lines = random_lines(seed, BLOCK)
        yield "centroid", centroid.find(lines)
        yield "fit", fit.find(lines)


def write(path: Path, device: str) -> None:
    """Store counts, flags, positions and deviations of all peaks."""
    parts: dict[str, list[NDArray[np.generic]]] = {}
    for method, peaks in both(device):
        there = np.isfinite(peaks.position_px)
        parts.setdefault(f"{method}_count", []).append(peaks.count.astype(np.uint8))
        parts.setdefault(f"{method}_flags", []).append(peaks.flags[there].astype(np.uint8))
        parts.setdefault(f"{method}_position", []).append(peaks.position_px[there])
        parts.setdefault(f"{method}_sigma", []).append(peaks.sigma_px[there])
    arrays: dict[str, Any] = {name: np.concatenate(found) for name, found in parts.items()}
    np.savez_compressed(path, **arrays)


def compare(path: Path, device: str) -> dict[str, dict[str, float]]:
    """Return per method the scans, peaks, differing scans and largest difference.

    A line differs when its peaks or their flags do; the difference is of positions in their
    stated standard deviations, over all others.
    """
    stored = np.load(path)
    figures: dict[str, dict[str, float]] = {}
    at: dict[str, tuple[int, int]] = {}
    for method, peaks in both(device):
        own = figures.setdefault(
            method, {"lines": 0, "peaks": 0, "lines_that_differ": 0, "largest_sigmas": 0.0}
        )
        line, peak = at.get(method, (0, 0))
        count = stored[f"{method}_count"][line : line + len(peaks)].astype(np.int64)
        end = peak + int(count.sum())
        room = np.arange(ROOM) < count[:, None]
        expected = PeakBatch.empty(len(peaks), ROOM)
        expected.position_px[room] = stored[f"{method}_position"][peak:end]
        expected.sigma_px[room] = stored[f"{method}_sigma"][peak:end]
        expected.flags[room] = stored[f"{method}_flags"][peak:end]
        same = (peaks.count == count) & (peaks.flags == expected.flags).all(axis=1)
        apart = abs(peaks.position_px - expected.position_px) / expected.sigma_px
        own["lines"] += len(peaks)
        own["peaks"] += end - peak
        own["lines_that_differ"] += int((~same).sum())
        own["largest_sigmas"] = max(own["largest_sigmas"], float(np.nanmax(apart[same])))
        at[method] = (line + len(peaks), end)
    return figures


def main(argv: Sequence[str] | None = None) -> int:
    """Write the CPU's peaks, or print the differences of a device's peaks."""
    parser = argparse.ArgumentParser(prog="benchmarks.cpu_cuda_agreement", description=__doc__)
    parser.add_argument("--write", type=Path, help="file to write the peaks to (.npz)")
    parser.add_argument("--compare", type=Path, help="file to compare with")
    parser.add_argument("--device", default="cpu", help="cpu, cuda:0, ...")
    options = parser.parse_args(argv)
    if options.write is not None:
        write(options.write, options.device)
    if options.compare is not None:
        for method, figures in compare(options.compare, options.device).items():
            print(method, ", ".join(f"{name} {value:g}" for name, value in figures.items()))
    return 0


if __name__ == "__main__":
    sys.exit(main())
