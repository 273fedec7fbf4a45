"""Lines to post: two scenes with noise, and the noise that they were made with."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from service.api.line_scans.schema import PixelNoise
from tests.compute.signal.synthetic_scans import (
    FULL,
    GAIN,
    OFFSET,
    READ,
    gaussian_counts,
    measured,
)

NOISE = PixelNoise(
    electrons_per_count=GAIN,
    read_noise_electrons=READ,
    offset_counts=OFFSET,
    full_scale_counts=FULL,
)
WIDTH = 1.2
PLACES = ((100.3, 250.2, 253.9), (30.3, 410.7))
HEIGHTS = ((800.0, 900.0, 500.0), (80.0, 6000.0))


def scenes(seed: int = 1) -> NDArray[np.uint16]:
    """Two lines: a single peak and a close pair; a faint peak and a saturated one."""
    counts = np.stack(
        [
            gaussian_counts(512, places, np.full(len(places), WIDTH), heights).sum(axis=0)
            for places, heights in zip(PLACES, HEIGHTS, strict=True)
        ]
    )
    return measured(counts, np.random.default_rng(seed), full=FULL)


def noisy(light_counts: NDArray[np.float64], seed: int) -> NDArray[np.uint16]:
    """Counts of pixels that get this light [counts], with the noise that NOISE says."""
    rng = np.random.default_rng(seed)
    electrons = rng.poisson(light_counts * NOISE.electrons_per_count).astype(np.float64)
    electrons += rng.normal(0.0, NOISE.read_noise_electrons, electrons.shape)
    counts = electrons / NOISE.electrons_per_count + NOISE.offset_counts
    return np.clip(np.rint(counts), 0, 65535).astype(np.uint16)


def body(method: dict[str, Any], **changes: Any) -> dict[str, Any]:
    """A request with both lines and their noise."""
    return {
        "scans": scenes().tolist(),
        "method": method,
        "noise": NOISE.model_dump(),
    } | changes
