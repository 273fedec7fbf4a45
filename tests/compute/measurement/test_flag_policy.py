"""The flag policy: its table, its documentation, and the errors of flagged peaks behind it."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.special import ndtr

from compute.flags import flag_names
from compute.measurement.flag_policy import (
    FIT_RULES,
    KNOWN_SHAPE_RULES,
    SHADOW_RULES,
    STANDARD_POLICY,
    FlagPolicy,
)
from compute.signal.centroid_finder import CentroidFinder
from compute.signal.centroid_settings import CentroidSettings
from compute.signal.fit.fit_finder import FitFinder
from compute.signal.fit.fit_settings import FitSettings
from compute.signal.peaks import PeakBatch, PeakFlag
from compute.signal.sensor_noise import SensorNoise

Array = NDArray[np.float64]

DOCS = Path(__file__).parents[3] / "docs"
PIXELS, SCANS, WIDTH_PX = 160, 3000, 2.0
GAIN, OFFSET, FULL, READ = 10.0, 100.0, 4095, 20.0
NOISE = SensorNoise.of(GAIN, READ, OFFSET, FULL)


def test_docs_page_holds_the_table() -> None:
    command = [sys.executable, str(DOCS / "generators" / "flags.py")]
    table = subprocess.run(command, capture_output=True, check=True, text=True).stdout
    assert table in (DOCS / "reference" / "flags.md").read_text()


def test_every_flag_has_one_rule_and_one_reason() -> None:
    assert [rule.flag for rule in STANDARD_POLICY.rules] == list(PeakFlag)
    for rule in (*STANDARD_POLICY.rules, *FIT_RULES, *KNOWN_SHAPE_RULES, *SHADOW_RULES):
        assert rule.why.endswith(".")
        assert rule.sigma_factor >= 1.0
        # What a peak costs in certainty is said of suspect peaks only.
        assert rule.use == "suspect" or (rule.sigma_factor, rule.added_sigma_px) == (1.0, 0.0)
    with pytest.raises(ValueError, match="one rule"):
        FlagPolicy(STANDARD_POLICY.rules[1:])


@pytest.mark.parametrize(
    ("method", "known", "suspect", "refused"),
    [
        ("centroid", False, "saturated merged poor-fit unfitted ambiguous", "clipped"),
        ("centroid", True, "saturated merged unfitted ambiguous", "clipped"),
        ("fit", False, "saturated merged poor-fit unfitted ambiguous", "clipped"),
        ("fit", True, "saturated merged unfitted ambiguous", "clipped"),
        ("shadow", False, "saturated merged unfitted ambiguous", ""),
    ],
)
def test_policy_by_method(method: str, known: bool, suspect: str, refused: str) -> None:
    policy = FlagPolicy.of_method(method, known_shape=known)  # type: ignore[arg-type]

    def names(use: str) -> str:
        flags = (str(rule.flag.name) for rule in policy.rules if rule.use == use)
        return " ".join(name.lower().replace("_", "-") for name in flags)

    assert names("suspect") == suspect
    assert names("refused") == refused


@pytest.mark.parametrize("method", ["centroid", "fit", "shadow"])
@pytest.mark.parametrize("known", [False, True])
def test_unclear_flags_are_the_same_for_every_method(method: str, known: bool) -> None:
    """A capture reads peaks without knowing how they were found."""
    policy = FlagPolicy.of_method(method, known_shape=known)  # type: ignore[arg-type]
    assert policy.unclear_flags == STANDARD_POLICY.unclear_flags
    names = " ".join(flag_names(policy.unclear_flags))
    assert names == "saturated clipped merged unfitted ambiguous"


def test_lookup_combines_flags() -> None:
    """The largest factor counts, variances add, and one refusal or veto is enough."""
    known = STANDARD_POLICY.lookup
    both = int(PeakFlag.SATURATED | PeakFlag.POOR_FIT)
    assert known.variance_factor[both] == 9.0
    assert known.variance_factor[int(PeakFlag.JOINT | PeakFlag.TRUNCATED)] == 1.0
    merged = int(PeakFlag.MERGED | PeakFlag.SATURATED)
    assert (known.variance_factor[merged], known.added_variance_px2[merged]) == (9.0, 4.0)
    assert known.shared[merged]
    assert known.initiates[merged]
    assert not known.initiates[int(PeakFlag.AMBIGUOUS | PeakFlag.JOINT)]
    assert known.refused[int(PeakFlag.CLIPPED | PeakFlag.JOINT)]
    assert not known.suspect[0]
    for value in range(256):
        rules = [rule for rule in STANDARD_POLICY.rules if value & int(rule.flag)]
        assert known.refused[value] == any(rule.use == "refused" for rule in rules)
        assert known.suspect[value] == any(rule.use == "suspect" for rule in rules)
        assert known.initiates[value] == all(rule.initiates for rule in rules)


def scans(pairs: bool) -> tuple[NDArray[np.uint16], Array]:
    """Return scans of one stripe or of two at 0 to 8 widths, of any brightness, and the truth."""
    rng = np.random.default_rng(1)
    centre = rng.uniform(60.0, 100.0, (SCANS, 1))
    if pairs:
        centre = np.hstack([centre, centre + rng.uniform(0.5, 16.0, (SCANS, 1))])
    light = np.exp(rng.uniform(np.log(3e3), np.log(6e5), centre.shape))
    edge = np.arange(PIXELS + 1) - 0.5
    shape = np.diff(ndtr((edge - centre[..., None]) / WIDTH_PX), axis=2)
    electrons = np.einsum("nk,nkp->np", light, shape)
    seen = rng.poisson(electrons + 20.0) + READ * rng.standard_normal(electrons.shape)
    return np.clip(np.rint(seen / GAIN + OFFSET), 0, FULL).astype(np.uint16), centre


def errors(found: PeakBatch, true: Array, flags: PeakFlag) -> tuple[float, float, int]:
    """Return the RMS error [px] and normalised error of the peaks with these flags alone."""
    row, peak = np.nonzero(np.isfinite(found.position_px) & (found.flags == int(flags)))
    off = found.position_px[row, peak, None] - true[row]
    off = np.take_along_axis(off, np.abs(off).argmin(axis=1)[:, None], axis=1)[:, 0]
    normalised = off / found.sigma_px[row, peak]
    return float(np.sqrt(np.mean(off**2))), float(np.sqrt(np.mean(normalised**2))), len(off)


def test_errors_of_flagged_peaks_are_what_the_factors_say() -> None:
    """Prints the errors behind the factors of the policy, as docs/decisions/0016 quotes them."""
    fit = FitFinder(
        SCANS, PIXELS, FitSettings(width_px=WIDTH_PX, width_log_sigma=0.0), NOISE, device="cpu"
    )
    centroid = CentroidFinder(SCANS, PIXELS, CentroidSettings(), NOISE, device="cpu")
    single, pairs = scans(pairs=False), scans(pairs=True)
    figures = {}
    for name, finder, (lines, true), flags in (
        ("fit, none", fit, single, PeakFlag.NONE),
        ("fit, saturated", fit, single, PeakFlag.SATURATED),
        ("fit, joint", fit, pairs, PeakFlag.JOINT),
        ("fit, joint and saturated", fit, pairs, PeakFlag.JOINT | PeakFlag.SATURATED),
        ("centroid, none", centroid, single, PeakFlag.NONE),
        ("centroid, saturated", centroid, single, PeakFlag.SATURATED),
        ("centroid, merged", centroid, pairs, PeakFlag.MERGED),
    ):
        figures[name] = errors(finder.find(lines), true, flags)
        rms, normalised, count = figures[name]
        print(f"{name}: {count} peaks, {rms:.3f} px RMS, {normalised:.2f} standard deviations RMS")
    for name in ("none", "saturated", "joint", "joint and saturated"):
        assert 0.9 < figures[f"fit, {name}"][1] < 1.1
    assert 0.9 < figures["centroid, none"][1] < 1.1
    assert 2.0 < figures["centroid, saturated"][1] < 3.0
    assert 1.5 < figures["centroid, merged"][0] < 3.0
