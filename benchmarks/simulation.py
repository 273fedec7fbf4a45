"""Benchmark of simulated frames per second: ``python -m benchmarks.simulation``.

Frames of four sensors of 2048 pixels (the profile ``bar``) with four markers lit at once, in
batches of eight, on one core: optics from tables, light on the pixels, and the detector's noise,
step upon step; beside the same with every ray traced, and beside Gaussian lines of ideal lenses.
"""

import argparse
import json
import os
import sys
import time
from collections.abc import Callable, Sequence

# One core, for every library that would start threads; before NumPy is loaded, or in vain.
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
if "numpy" not in sys.modules:
    os.environ.update(dict.fromkeys(THREADS, "1"))

import numpy as np  # noqa: E402
from numpy.typing import NDArray  # noqa: E402

from compute.optics.detector import Detector  # noqa: E402
from compute.optics.detector_array import DetectorArray  # noqa: E402
from compute.optics.ideal_optics import IdealOptics  # noqa: E402
from compute.optics.pixel_solid_angles import (  # noqa: E402
    SolidAngleOptics,
    scan_electrons,
    stripe_images,
)
from compute.optics.profiles.device_profile import DeviceProfile  # noqa: E402
from compute.optics.profiles.profile_loader import load_profile  # noqa: E402
from compute.optics.profiles.profile_optics import light_source, profile_optics  # noqa: E402
from compute.optics.sensor_placement import place_sensor  # noqa: E402
from validation.signal_chain.background import BumpBackground, background_scans  # noqa: E402

Array = NDArray[np.float64]
Row = dict[str, str | int | float]

PROFILE = "bar"
FRAMES, MARKERS = 8, 4
BATCHES = 16  # of other points each, so that no cache holds the answer
WHOLE = "tables, light and noise of equal pixels"


class Scene:
    """Random points of the profile's volume, their light, and its detectors."""

    def __init__(self, profile: DeviceProfile) -> None:
        rng = np.random.default_rng(1)
        centre, size = np.array(profile.volume.centre_mm), np.array(profile.volume.size_mm)
        shape = (BATCHES, FRAMES * MARKERS, 3)
        self.points_mm = centre + size * (rng.random(shape) - 0.5)
        self.profile = profile
        self.pixels = profile.pixels.count
        self._source = light_source(profile)
        self._lenses_mm = np.array([sensor.position_mm for sensor in profile.sensors])
        self._rng = np.random.Generator(np.random.SFC64(2))
        self.patterned = profile.detector.detector(profile.rates.exposure_s)
        self.even = Detector(
            bits=self.patterned.bits,
            electrons_per_count=self.patterned.electrons_per_count,
            offset_counts=self.patterned.offset_counts,
            read_noise_electrons=self.patterned.read_noise_electrons,
            full_well_electrons=self.patterned.full_well_electrons,
            ambient_electrons=self.patterned.ambient_electrons,
            dark_electrons=self.patterned.dark_electrons,
        )

    def array(self, detector: Detector, background: Array | None = None) -> DetectorArray:
        """Return the detectors of all sensors."""
        return DetectorArray(
            detector,
            len(self._lenses_mm),
            self.pixels,
            pattern_seed=1,
            background_electrons=background,
        )

    def shaped_background(self) -> Array:
        """Return a lamp's reflection on every line, shape (S, pixels)."""
        lamp = BumpBackground(centre_px=700.0, sigma_px=250.0, peak_electrons=400.0)
        return background_scans([lamp] * len(self._lenses_mm), self.pixels)

    def signal(self, optics: SolidAngleOptics, batch: int) -> Array:
        """Return the mean electrons of a batch, shape (frames, S, pixels)."""
        points = self.points_mm[batch]
        photons = self._source.photons_per_sr(
            points, None, self._lenses_mm, self.profile.rates.exposure_s
        )
        efficiency = self.profile.detector.quantum_efficiency
        solid_angles = optics.solid_angles(points)
        return scan_electrons(solid_angles, photons * efficiency, MARKERS, self.pixels)

    def expose(self, detectors: DetectorArray, signal: Array) -> NDArray[np.uint16]:
        """Return the counts of a batch."""
        return detectors.expose(signal, self._rng)

    def ideal(self) -> Callable[[int], Array]:
        """Return a renderer of Gaussian stripes as wide as those of the lens."""
        placed = [
            place_sensor(
                sensor.name,
                lens_position_mm=sensor.position_mm,
                aim_mm=sensor.aim_mm,
                measured_direction=sensor.measured_direction,
                principal_distance_mm=37.0,
                pixels=self.pixels,
                pitch_um=self.profile.pixels.pitch_um,
            )
            for sensor in self.profile.sensors
        ]
        optics = IdealOptics(
            placed, spot_sigma_px=2.0, signal_electrons=1e5, reference_distance_mm=1500.0
        )

        def signal(batch: int) -> Array:
            spots = optics.stripes(self.points_mm[batch])
            by_line = [
                values.reshape(FRAMES, MARKERS, -1).transpose(0, 2, 1).reshape(-1, MARKERS)
                for values in (spots.position_px, spots.sigma_px, spots.electrons)
            ]
            lines = stripe_images(by_line[0], by_line[1], by_line[2], self.pixels)
            return lines.reshape(FRAMES, -1, self.pixels)

        return signal


def run(seconds: float = 2.0) -> list[Row]:
    """Measure all steps.

    Rows have the keys method, frames_per_s (of the batch that took the least of the processor's
    time), median_frames_per_s, wall_frames_per_s (the quickest by the clock on the wall), and
    times_whole: how many times as fast as whole frames of tabulated optics.
    """
    profile = load_profile(PROFILE)
    scene = Scene(profile)
    tables, exact = (profile_optics(profile, mode) for mode in ("tabulated", "exact"))
    ideal = scene.ideal()
    even = scene.array(scene.even)
    patterned = scene.array(scene.patterned)
    shaped = scene.array(scene.patterned, scene.shaped_background())
    methods: dict[str, Callable[[int], object]] = {
        "tables": lambda batch: tables.solid_angles(scene.points_mm[batch]),
        "tables and light": lambda batch: scene.signal(tables, batch),
        WHOLE: lambda batch: scene.expose(even, scene.signal(tables, batch)),
        "the same, pixels differ": (
            lambda batch: scene.expose(patterned, scene.signal(tables, batch))
        ),
        "the same, shaped background too": (
            lambda batch: scene.expose(shaped, scene.signal(tables, batch))
        ),
        "every ray traced, light and noise": (
            lambda batch: scene.expose(even, scene.signal(exact, batch))
        ),
        "ideal Gaussian lines, light and noise": lambda batch: scene.expose(even, ideal(batch)),
        "ideal Gaussian lines and light": ideal,
    }
    rows = [_measured(name, render, seconds) for name, render in methods.items()]
    whole = next(float(row["frames_per_s"]) for row in rows if row["method"] == WHOLE)
    for row in rows:
        row["times_whole"] = float(row["frames_per_s"]) / whole
    return rows


def _measured(name: str, render: Callable[[int], object], seconds: float) -> Row:
    """Render batches for ``seconds``, at least three."""
    render(0)
    process: list[int] = []
    wall: list[int] = []
    end = time.perf_counter() + seconds
    while len(process) < 3 or time.perf_counter() < end:
        wall_ns, process_ns = time.perf_counter_ns(), time.process_time_ns()
        render(len(process) % BATCHES)
        process.append(time.process_time_ns() - process_ns)
        wall.append(time.perf_counter_ns() - wall_ns)
    return {
        "method": name,
        "frames_per_s": FRAMES * 1e9 / max(1, min(process)),
        "median_frames_per_s": FRAMES * 1e9 / max(1.0, float(np.median(process))),
        "wall_frames_per_s": FRAMES * 1e9 / max(1, min(wall)),
    }


def main(argv: Sequence[str] | None = None) -> int:
    """Print the rows as a table, or as JSON."""
    parser = argparse.ArgumentParser(prog="benchmarks.simulation", description=__doc__)
    parser.add_argument("--seconds", type=float, default=2.0, help="time for each method")
    parser.add_argument("--json", action="store_true", help="print JSON")
    options = parser.parse_args(argv)
    rows = run(options.seconds)
    if options.json:
        json.dump(rows, sys.stdout, indent=2)
        print()
        return 0
    print(f"{'frames/s on one core':40} {'best':>8} {'median':>8} {'by wall':>8} {'x whole':>8}")
    for row in rows:
        print(
            f"{row['method']:40} {row['frames_per_s']:8.0f} {row['median_frames_per_s']:8.0f} "
            f"{row['wall_frames_per_s']:8.0f} {row['times_whole']:8.3f}"
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
