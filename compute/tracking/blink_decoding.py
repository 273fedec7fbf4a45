"""Blink decoding: identification of markers by their codes over successive scans.

Thesis, section 4.6: a target "releases pulses of light, which could also be modulated for easier
identification"; here by pulse codes, one bit a scan.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.errors import InvalidParameter
from compute.tracking.blink_codes import BlinkCodes

Array = NDArray[np.float64]

_LOG_ROOT_TWO_PI: Final = 0.5 * float(np.log(2.0 * np.pi))


@dataclass(frozen=True)
class BlinkModel:
    """Detection model of a blinking marker's peaks.

    Args:
        miss_probability: of a scan in which the marker is on to have no peak of it.
        false_alarm_probability: of a scan in which it is off to have a peak that is taken for it.
        log_amplitude_sigma: standard deviation of the logarithm of its amplitude, from scan to
            scan.
        log_amplitude_range: range of the logarithm of false peaks' amplitudes.
        off_level: its light in "off" scans, relative to "on"; 0: none. A marker that only gets
            fainter is seen in every scan.
        non_marker_probability: prior, that a light is no marker: a reflection, always on, or one
            that comes and goes.
        confidence_threshold: probability with which a marker is named.

    Raises:
        InvalidParameter: a value out of its range.
    """

    miss_probability: float = 0.05
    false_alarm_probability: float = 0.05
    log_amplitude_sigma: float = 0.2
    log_amplitude_range: float = 4.6
    off_level: float = 0.0
    non_marker_probability: float = 0.1
    confidence_threshold: float = 0.999

    def __post_init__(self) -> None:
        for name in (
            "miss_probability",
            "false_alarm_probability",
            "non_marker_probability",
            "confidence_threshold",
        ):
            value = getattr(self, name)
            if not 0.0 < value < 1.0:
                raise InvalidParameter(
                    f"{name} is {value}; it must lie between 0 and 1", **{name: value}
                )
        if not (
            self.log_amplitude_sigma > 0.0
            and self.log_amplitude_range > 0.0
            and 0.0 <= self.off_level < 1.0
        ):
            raise InvalidParameter(
                f"log_amplitude_sigma, log_amplitude_range and off_level are "
                f"{self.log_amplitude_sigma}, {self.log_amplitude_range} and {self.off_level}; "
                "the first two must be positive, the last from 0 to less than 1"
            )


@dataclass(frozen=True, eq=False)
class BlinkIdentities:
    """Identified markers of T lights.

    Args:
        marker: index of its word, -1: not sure, int32, shape (T,).
        phase: bit of the word that the first scan shows, int32, shape (T,); of no meaning where
            the marker is not known.
        confidence: probability that it is the most probable marker, named or not, shape (T,).
        errors: scans in which it was on instead of off or the other way round, by that word,
            int32, shape (T,).
    """

    marker: NDArray[np.int32]
    phase: NDArray[np.int32]
    confidence: Array
    errors: NDArray[np.int32]


def identify_blinking_markers(
    codes: BlinkCodes,
    amplitude: Array,
    model: BlinkModel | None = None,
    phase: int | None = None,
    known: NDArray[np.bool_] | None = None,
) -> BlinkIdentities:
    """Identify the marker of each light, from its amplitudes over a window of scans.

    Every word in every phase is a hypothesis, beside a steady light and one that comes and goes by
    probability. The likelihood is that of peaks present and absent, and of the logarithms of their
    amplitudes about a mean that each hypothesis has for itself, so that how bright or near a
    marker is does not matter. Sensors are independent, each with its own mean; those that
    never saw the light in the window say nothing. Of two lights that are named alike, only
    the likelier is, if it is so by the odds that ``confidence_threshold`` demands; else neither.

    Args:
        codes: the words.
        amplitude: of T lights, tracked or on one sensor, over W successive scans, shape (T, W), or
            by S sensors, shape (T, S, W); NaN where there was no peak. Any unit.
        model: how peaks come about; None: the standard.
        phase: bit of the words that the first scan shows, where the scans are synchronised; None:
            not known, which needs cyclic codes.
        known: where it can be said whether there was a peak, of the amplitudes' shape: not in a
            lost frame, or where two lights share a peak; None: everywhere.

    Raises:
        InvalidParameter: another shape, no phase for words that are not cyclic, or an amplitude
            that is not positive.
    """
    values = np.asarray(amplitude, dtype=np.float64)
    if values.ndim == 2:
        values = values[:, None]
    if values.ndim != 3:
        raise InvalidParameter(
            f"amplitude has the shape {np.shape(amplitude)}; it must be (T, W) or (T, S, W)"
        )
    if known is None:
        there = np.ones(values.shape, dtype=np.bool_)
    elif np.shape(known) != np.shape(amplitude):
        raise InvalidParameter(
            f"known has the shape {np.shape(known)}, amplitude {np.shape(amplitude)}; "
            "they must have one"
        )
    else:
        there = np.asarray(known, dtype=np.bool_).reshape(values.shape)
        values = np.where(there, values, np.nan)
    if phase is None and not codes.cyclic:
        raise InvalidParameter("these words are not cyclic; give the phase of the first scan")
    if (values <= 0.0).any():
        raise InvalidParameter("an amplitude is not positive; give NaN where there was no peak")
    how = model or BlinkModel()
    phases = np.arange(codes.length) if phase is None else np.array([phase % codes.length])
    scans = np.arange(values.shape[-1])
    # By word, then phase, shape (H, W).
    on = codes.bits[:, (phases[:, None] + scans) % codes.length].reshape(-1, len(scans))
    likelihood = _log_likelihood(on, values, there, how) - np.log(
        len(on) / (1.0 - how.non_marker_probability)
    )
    others = np.logaddexp(
        _log_likelihood(np.ones((1, len(scans)), dtype=np.bool_), values, there, how)[:, 0],
        _log_likelihood_random(values, there, how),
    ) + np.log(0.5 * how.non_marker_probability)
    every = np.concatenate([likelihood, others[:, None]], axis=1)
    top = every.max(axis=1, keepdims=True)
    weight = np.exp(every - top)
    share = weight / weight.sum(axis=1, keepdims=True)
    by_word = share[:, :-1].reshape(len(values), len(codes), len(phases)).sum(axis=2)
    word = by_word.argmax(axis=1)
    rows = np.arange(len(values))
    best_phase = likelihood.reshape(len(values), len(codes), -1)[rows, word].argmax(axis=1)
    confidence = by_word[rows, word]
    marker = np.where(confidence >= how.confidence_threshold, word, -1)
    marker = _resolve_duplicates(marker, likelihood.max(axis=1) - others, how)
    expected = on.reshape(len(codes), len(phases), -1)[word, best_phase]
    return BlinkIdentities(
        marker.astype(np.int32),
        phases[best_phase].astype(np.int32),
        confidence,
        _errors(expected, values, there, how),
    )


def _log_likelihood(
    on: NDArray[np.bool_], amplitude: Array, known: NDArray[np.bool_], model: BlinkModel
) -> Array:
    """Return log likelihoods of hypotheses (H, W) for lights (T, S, W), shape (T, H)."""
    present = np.isfinite(amplitude)
    missing = (known & ~present).astype(np.float64)
    detected: NDArray[np.bool_] = np.asarray(present.any(axis=2))
    log_amplitude = np.where(present, np.log(np.where(present, amplitude, 1.0)), 0.0)
    # Middle values keep the sums of squares from cancelling.
    centre = log_amplitude.sum(axis=2) / np.maximum(present.sum(axis=2), 1)
    value = np.where(present, log_amplitude - centre[..., None], 0.0)
    lit = on.T.astype(np.float64)
    there = present.astype(np.float64)
    if model.off_level > 0.0:
        # On or low, a peak is due in every scan, at one of two levels.
        level = np.log(model.off_level) * (1.0 - lit)
        count = np.broadcast_to(there.sum(axis=2)[..., None], (*detected.shape, lit.shape[1]))
        first = value.sum(axis=2)[..., None] - there @ level
        second = (value**2).sum(axis=2)[..., None] - 2.0 * value @ level + there @ level**2
        absent = float(np.log(model.miss_probability)) * missing.sum(axis=2)[..., None]
        unlit = np.zeros(1)
    else:
        count = there @ lit
        first = value @ lit
        second = value**2 @ lit
        absent = float(np.log(model.miss_probability)) * (missing @ lit)
        dark_false = there @ (1.0 - lit)
        dark_empty = missing @ (1.0 - lit)
        unlit = dark_false * float(
            np.log(model.false_alarm_probability / model.log_amplitude_range)
        )
        unlit = unlit + dark_empty * float(np.log1p(-model.false_alarm_probability))
    # The mean is flat over the range beforehand, and integrated out.
    squares = second - first**2 / np.maximum(count, 1.0)
    normal = -0.5 * squares / model.log_amplitude_sigma**2 - count * (
        float(np.log(model.log_amplitude_sigma)) + _LOG_ROOT_TWO_PI
    )
    mean = float(np.log(model.log_amplitude_sigma / model.log_amplitude_range)) + _LOG_ROOT_TWO_PI
    normal = normal + np.where(count > 0, mean - 0.5 * np.log(np.maximum(count, 1.0)), 0.0)
    total = normal + count * float(np.log1p(-model.miss_probability)) + absent + unlit
    likelihood: Array = np.where(detected[..., None], total, 0.0).sum(axis=1)
    return likelihood


def _log_likelihood_random(amplitude: Array, known: NDArray[np.bool_], model: BlinkModel) -> Array:
    """Return the log likelihood of lights that come and go, of any brightness, shape (T,)."""
    present = np.isfinite(amplitude)
    detected: NDArray[np.bool_] = np.asarray(present.any(axis=2))
    scans = (detected[..., None] & known).sum(axis=(1, 2))
    peaks = present.sum(axis=(1, 2))
    likelihood: Array = scans * float(np.log(0.5)) - peaks * float(
        np.log(model.log_amplitude_range)
    )
    return likelihood


def _resolve_duplicates(
    marker: NDArray[np.intp], odds: Array, model: BlinkModel
) -> NDArray[np.intp]:
    """Keep a name that several lights have with the most probable only, if it is so for sure."""
    kept = marker.copy()
    needed = float(np.log(model.confidence_threshold / (1.0 - model.confidence_threshold)))
    for name in np.unique(marker[marker >= 0]):
        same = np.flatnonzero(marker == name)
        if len(same) < 2:
            continue
        order = same[np.argsort(-odds[same], kind="stable")]
        kept[same] = -1
        if odds[order[0]] - odds[order[1]] >= needed:
            kept[order[0]] = name
    return kept


def _errors(
    on: NDArray[np.bool_], amplitude: Array, known: NDArray[np.bool_], model: BlinkModel
) -> NDArray[np.int32]:
    """Count the scans in which a light contradicts its code word, shape (T,)."""
    present = np.isfinite(amplitude)
    if model.off_level > 0.0:
        with np.errstate(invalid="ignore"):
            level = np.where(present, amplitude, -np.inf).max(axis=2, keepdims=True)
            bright = present & (amplitude > np.sqrt(model.off_level) * level)
    else:
        bright = present
    # Most of the sensors that see the light at all, and could tell in this scan.
    detected: NDArray[np.bool_] = np.asarray(present.any(axis=2))
    counted = detected[..., None] & known
    lit = (bright & counted).sum(axis=1) * 2 > counted.sum(axis=1)
    wrong = (lit != on) & counted.any(axis=1)
    if model.off_level > 0.0:
        wrong &= present.any(axis=1)
    errors: NDArray[np.int32] = wrong.sum(axis=1).astype(np.int32)
    return errors
