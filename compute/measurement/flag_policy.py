"""FlagPolicy: what each peak flag means for triangulation, correspondence, tracking and pose."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, reduce
from operator import or_
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from compute.signal.peaks import PeakFlag

Array = NDArray[np.float64]

Use = Literal["used", "suspect", "refused"]
DetectionMethod = Literal["fit", "centroid", "shadow"]

MERGED_SIGMA_PX: Final = 2.0
"""Standard deviation of a merged peak's position as the reading of either of its two markers."""


@dataclass(frozen=True)
class FlagRule:
    """Treatment of peaks that have one flag.

    Args:
        flag: the flag, one bit.
        use: ``used`` as if it had no flag; ``suspect``: used, and points and tracks from it carry
            ``suspect-peak``; ``refused``: treated as not detected.
        why: the reason, one sentence.
        sigma_factor: factor on its standard deviation. Of several flags the largest counts.
        added_sigma_px: standard deviation that is added in squares [px].
        initiates: whether a track or the acquisition of a tool may rest on it.
        shared: whether it may be the peak of two markers. Stages that give a peak to one marker
            at most, as tools do, do not use it.
        clear: whether the peak of the only lit marker is a reading of it for a calibration.
    """

    flag: PeakFlag
    use: Use
    why: str
    sigma_factor: float = 1.0
    added_sigma_px: float = 0.0
    initiates: bool = True
    shared: bool = False
    clear: bool = True


STANDARD_RULES: Final = (
    FlagRule(
        PeakFlag.SATURATED,
        "suspect",
        "A centre of gravity takes the flat top for the shape of the peak.",
        sigma_factor=3.0,
        clear=False,
    ),
    FlagRule(
        PeakFlag.CLIPPED,
        "refused",
        "The end of the sensor cuts it off: the position is drawn inwards by an unknown amount.",
        initiates=False,
        clear=False,
    ),
    FlagRule(
        PeakFlag.MERGED,
        "suspect",
        "It lies between two stripes of light and may be the reading of either.",
        added_sigma_px=MERGED_SIGMA_PX,
        shared=True,
        clear=False,
    ),
    FlagRule(
        PeakFlag.TRUNCATED,
        "used",
        "Other peaks of the scan were left out; this one is as good as without the flag.",
    ),
    FlagRule(
        PeakFlag.JOINT,
        "used",
        "The joint fit's standard deviation includes the overlap with its neighbours.",
    ),
    FlagRule(
        PeakFlag.POOR_FIT,
        "suspect",
        "The assumed shape does not explain the pixels, and nothing says what that costs.",
        sigma_factor=3.0,
    ),
    FlagRule(
        PeakFlag.UNFITTED,
        "suspect",
        "It is a centre of gravity or a pixel, not a fit.",
        sigma_factor=3.0,
        initiates=False,
        clear=False,
    ),
    FlagRule(
        PeakFlag.AMBIGUOUS,
        "suspect",
        "The coded pattern fits nearly as well elsewhere: good only where a marker is expected.",
        initiates=False,
        clear=False,
    ),
    FlagRule(
        PeakFlag.MASKED_PIXELS,
        "used",
        "Bad pixels were left out of the fit, and the standard deviation holds what that costs.",
    ),
)
"""Rules of detection by centre of gravity where the error by the stripes' shape is not known."""

FIT_RULES: Final = (
    FlagRule(
        PeakFlag.SATURATED,
        "suspect",
        "The fit takes a full pixel for a lower bound, and its standard deviation says so.",
        clear=False,
    ),
)
"""Exceptions where peaks are fitted."""

KNOWN_SHAPE_RULES: Final = (
    FlagRule(
        PeakFlag.POOR_FIT,
        "used",
        "The error by the stripe's shape over the device's volume is in the standard deviation.",
    ),
)
"""Exceptions where the device's profile says what the assumed shape costs over its volume."""

SHADOW_RULES: Final = (
    FlagRule(
        PeakFlag.CLIPPED,
        "used",
        "A shadow is fitted as a whole; what lies beyond the sensor does not draw it inwards.",
        clear=False,
    ),
    FlagRule(
        PeakFlag.POOR_FIT,
        "used",
        "The root of the reduced chi-square is a factor in the standard deviation already.",
    ),
)
"""Exceptions for the shadows of coded windows."""


@dataclass(frozen=True, eq=False)
class FlagLookup:
    """Rules by the value of a peak's flags, each of shape (2^flags,).

    Args:
        refused: whether it is treated as not detected.
        suspect: whether points and tracks from it are marked.
        variance_factor: square of the factor on its standard deviation.
        added_variance_px2: variance that is added [px^2].
        initiates: whether a track or tool may be started from it.
        shared: whether it may be the peak of two markers.
    """

    refused: NDArray[np.bool_]
    suspect: NDArray[np.bool_]
    variance_factor: Array
    added_variance_px2: Array
    initiates: NDArray[np.bool_]
    shared: NDArray[np.bool_]


@dataclass(frozen=True)
class FlagPolicy:
    """Rules for all peak flags.

    Args:
        rules: one for each flag, in the order of the flags.

    Raises:
        ValueError: a flag without a rule, or with two.
    """

    rules: tuple[FlagRule, ...] = STANDARD_RULES

    def __post_init__(self) -> None:
        if [rule.flag for rule in self.rules] != list(PeakFlag):
            raise ValueError("each peak flag needs one rule, in the order of the flags")

    @classmethod
    def of_method(cls, method: DetectionMethod, *, known_shape: bool) -> "FlagPolicy":
        """Return the policy for peaks that were found by a method.

        Args:
            method: how positions are measured.
            known_shape: whether the standard deviations include the error by the stripes' shape.
        """
        policy = cls()
        if method == "fit":
            policy = policy.replace_rules(FIT_RULES)
        if method == "shadow":
            return policy.replace_rules(SHADOW_RULES)
        return policy.replace_rules(KNOWN_SHAPE_RULES) if known_shape else policy

    def replace_rules(self, rules: Sequence[FlagRule]) -> "FlagPolicy":
        """Return the policy with other rules for some flags."""
        other = {rule.flag: rule for rule in rules}
        return replace(self, rules=tuple(other.get(rule.flag, rule) for rule in self.rules))

    @cached_property
    def unclear_flags(self) -> PeakFlag:
        """The flags of peaks that are not clear."""
        return reduce(or_, (rule.flag for rule in self.rules if not rule.clear), PeakFlag.NONE)

    @cached_property
    def lookup(self) -> FlagLookup:
        """The rules for every combination of flags."""
        every = np.arange(1 << len(self.rules))
        has = np.array([(every & int(rule.flag)) != 0 for rule in self.rules])

        def any_of(values: Sequence[bool]) -> NDArray[np.bool_]:
            return np.asarray(has[np.array(values, dtype=np.bool_)].any(axis=0))

        factor = np.array([rule.sigma_factor for rule in self.rules])[:, None]
        added = np.array([rule.added_sigma_px for rule in self.rules])[:, None]
        return FlagLookup(
            any_of([rule.use == "refused" for rule in self.rules]),
            any_of([rule.use == "suspect" for rule in self.rules]),
            np.where(has, factor, 1.0).max(axis=0) ** 2,
            (np.where(has, added, 0.0) ** 2).sum(axis=0),
            ~any_of([not rule.initiates for rule in self.rules]),
            any_of([rule.shared for rule in self.rules]),
        )


STANDARD_POLICY: Final = FlagPolicy()
