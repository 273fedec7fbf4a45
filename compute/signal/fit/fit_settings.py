"""Settings of the weighted fit, and the definition of a fitted peak."""

from dataclasses import dataclass, field
from math import log
from typing import Final, Literal, get_args

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from compute.parameter_checks import require
from compute.signal.centroid_settings import (
    CentroidSettings,
    require_between,
    require_choice,
    require_integer,
)
from compute.signal.peaks import MAX_JOINT_PEAKS

BackgroundModel = Literal["surrounding-slope", "level", "slope"]
"""The background within a window: a straight line whose slope is that of the pixels beside the
window, a constant, or a straight line that is fitted within the window."""

SURROUNDING_PIXELS: Final = 16
MIN_SURROUNDING_PIXELS: Final = 8
"""Largest and smallest number of pixels to each side that the surroundings' slope is taken from."""

SURROUNDING_LIMIT_SIGMA: Final = 4.0
"""Largest deviation of half a side from the straight line through both sides."""

MISFIT_RATE: Final = 0.01
"""Probability of a chi-square beyond which the excess widens a standard deviation."""

MAX_ITERATIONS: Final = 20
CONVERGENCE_THRESHOLD_SIGMA: Final = 1e-3
"""A fit has ended when no parameter moves by more than this part of its standard deviation: of that
which the misfit says, where it says more than the noise. The step is still taken. What is left is
a tenth of it or less where the shape fits; where it does not, steps shrink only linearly."""

STEP_WIDTHS: Final = 0.5
STEP_LOG_WIDTH: Final = 0.25
"""A step moves no position by more than the one [widths], no logarithm of a width by the other."""

MIN_PIVOT: Final = 1e-9
"""Smallest pivot of an information matrix scaled to a diagonal of ones."""

SPLIT_WIDTHS: Final = 0.7
SPLIT_LOG_WIDTH: Final = 0.25
"""A peak is split into two so far to either side [widths], which are narrower by the other."""

MAX_WINDOW_PX: Final = 128
"""Largest number of pixels that are fitted together."""

WIDTH_LIMITS_PX: Final = (0.25, 16.0)
"""A fitted width [px] stays within these."""

NARROW_PX: Final = 1.0 / 3.0
NARROW_POWER: Final = 4
"""A width w is taken for less likely by ``exp(-(NARROW_PX/w)^NARROW_POWER)``: 4 % at 0.25 px, a
third at 0.333 px, 91 % at 0.6 px. So narrow a line lies in one or two pixels whatever its width;
peaks of noise would else be fitted by lines without width."""

LOG_WIDTH_SIGMA_THRESHOLD: Final = 0.03
"""A covariance is averaged over widths whose logarithm is known no better. Deviations grow by about
three times its square: 0.3 % at this."""

MIN_LOG_WEIGHT: Final = -7.0
"""Widths of less weight than this one's exponential, beside the best one's, end a side."""

MAX_LOG_LIKELIHOOD_RISE: Final = 1.0
"""Widths whose likelihood is above the best one's by more than this one's exponential end a side:
they belong to another of its maxima."""

MAX_WIDTH_NODES: Final = 6
"""Largest number of widths to either side of the best one."""


@dataclass(frozen=True)
class FitSettings:
    """Settings of the weighted fit: the best position estimate that the pixels allow.

    The definition, which the kernel and the reference both implement:

    - *Candidates.* The peaks that ``search`` finds, from their centres of gravity, heights and
      widths at the threshold. The width to start with is ``width_px`` where ``width_log_sigma`` is
      zero, and else the candidate's width over that of a Gaussian at its threshold
      (``2 sqrt(-2 ln f)`` deviations), not further from ``width_px`` than two ``width_log_sigma``
      in the logarithm.
    - *Groups.* A candidate's window reaches ``ceil(reach w) + 1`` pixels, 63 at most, to either
      side of the pixel that its centre is in. Neighbours whose windows overlap are fitted
      together. A chain of more than ``max_joint_peaks``, or longer than MAX_WINDOW_PX, is cut where
      the gap between neighbours is widest, again and again, and those at a cut are MERGED. A
      window ends midway between two groups, and at the line's ends. Pixels at full scale are
      left out, as they say only "at least".
    - *Model.* ``mu_i = b [+ s (i - middle)] + sum_k A_k (E((i + 1/2 - x_k)/w) - E((i - 1/2 -
      x_k)/w))`` with positions x_k, light A_k [counts], one width w for the group, a level b and
      a slope s about the window's middle. E is a ``LineSpreadFunction``.
    - *Slope.* "surrounding-slope" takes it from up to SURROUNDING_PIXELS to either side, between
      the window and those of the neighbouring groups: the difference of both means over their
      distance. It is zero where a side has fewer than MIN_SURROUNDING_PIXELS, or where the means of
      a side's halves are off the line by more than SURROUNDING_LIMIT_SIGMA: there is other light.
      "slope" fits it within the window, where it is hard to tell from a shift of the line: a faint
      line's standard deviation grows by 4 %. "level" has none.
    - *Calibrated pixels.* With ``PixelCorrections`` the counts are the corrected ones, the variance
      of a pixel with the scale a is ``a (a read^2/gain^2 + max(mu - offset, 0)/gain + a/12)``, and
      masked pixels are left out: MASKED_PIXELS.
    - *Weights.* The variance V of a pixel is ``read^2/gain^2 + max(mu - offset, 0)/gain + 1/12``
      plus ``(shape_error (mu - b - ...))^2``, by the model and not by the pixel's own noise.
    - *Estimate.* The root of the weighted residuals' score, with the variances of the same mu:
      ``sum_i (v_i - mu_i) dmu_i / V_i = 0``, with the width's prior. This is the greatest
      quasi-likelihood (R. W. M. Wedderburn, 10.1093/biomet/61.3.439): the maximum likelihood
      but for the variances' own information, of order 1 over the electrons of a pixel.
    - *Prior.* The logarithm of the width is normal about that of ``width_px``, with the deviation
      ``width_log_sigma``; and lines narrower than a pixel's parts are improbable: a width w weighs
      ``exp(-(n/w)^NARROW_POWER)``, n being ``narrow_width_px``.
    - *Way there.* Fisher scoring from the search's background and candidates (light by height,
      the widths' geometric mean): steps ``d = H^-1 g`` by score g and information H, scaled as a
      whole to STEP_WIDTHS and STEP_LOG_WIDTH; a width that would leave WIDTH_LIMITS_PX is held
      there, as if known. A step that turns the width of a single line back is scaled by
      ``l / (l + c)``, c being its change of the width's logarithm and l the last one (the
      secant's step). The end is ``g.d < CONVERGENCE_THRESHOLD_SIGMA^2 max(chi2/freedom, 1)``, by
      the pass's own chi-square with the prior's term, and that step is taken. The covariance is
      H^-1, and with the chi-square of the pass that gave the last step.
    - *Number of peaks.* Where the misfit is significant (at the rate
      ``false_split_rate``) or the fit failed, the window grows by as much as the widest
      candidate's window reaches, up to midway to the neighbours' windows and MAX_WINDOW_PX, and
      the fit is repeated there. Then one peak more is tried, from each peak split in two
      (SPLIT_WIDTHS) and at the pixel of the largest residual in deviations. The best of these
      stands if ``sum ((v - mu)^2/V + ln V)`` and the prior's term fall by more than ``dp ln n +
      2 ln(1/false_split_rate)``, dp = 2 the parameters that it adds and n the pixels: Schwarz's
      criterion (10.1214/aos/1176344136) with a margin for the places where it was looked for.
      This is repeated while the misfit is significant, up to ``max_joint_peaks``. Where none
      stands, the first window's fit does, or else the grown one's. Without
      ``further_peaks`` none is tried, and only a failed fit is repeated in the grown window.
    - *Unknown width.* Where the deviation of the width's logarithm is more than
      LOG_WIDTH_SIGMA_THRESHOLD, or it is held at a limit, the covariance is averaged over widths:
      from the best one to either side, by that deviation or STEP_LOG_WIDTH, whichever is less, as
      far as there are any in WIDTH_LIMITS_PX, all lights are positive, they weigh more than
      MIN_LOG_WEIGHT, their likelihood is not above the best one's (MAX_LOG_LIKELIHOOD_RISE), and to
      MAX_WIDTH_NODES. Each has its own best parameters and covariance, from the one before by one
      scoring step. Its weight is the likelihood with the prior, by the trapezoidal rule from its
      slopes, times the (geometric mean of the) positions' deviations at that width: so all shifts
      and scales are equally probable, for which Bayes's deviations are those of repeated
      experiments (right Haar measure; J. O. Berger, 10.1007/978-1-4757-4286-2, chapter 6). The
      covariance is that of the average. The parameters stay the best ones: those at a mean width,
      or their mean, are biased more within a pixel, as widths are less certain to the narrow side.
    - *Misfit.* Where chi-square is beyond what noise exceeds with the probability MISFIT_RATE, the
      covariance is multiplied by ``1 + excess / freedom`` (R. T. Birge, 10.1103/PhysRev.40.207),
      unless ``widen_misfit`` is False.
    - *Result.* Positions, standard deviations and covariances; ``amplitude`` is the fitted light
      in a pixel about the line's middle; ``width_px`` the full width at ``search``'s
      threshold of a Gaussian with the fitted width; the reduced chi-square of the group, of
      which a finite prior is one more observation. Flags:
      JOINT, POOR_FIT (a chi-square less probable than ``false_split_rate``), SATURATED (a pixel
      of the window was left out), CLIPPED (a line less than two widths from an end of the
      sensor), MERGED (at a cut, or a candidate with a valley that got no further peak), and
      UNFITTED with all of the candidate's own figures where no more pixels than parameters are
      left, the fit does not converge, the information is singular (MIN_PIVOT), a light is not
      above its standard deviation, or a position leaves its window. Of more peaks than
      ``search`` has room for, the brightest are kept, TRUNCATED.

    Args:
        search: how candidates are found.
        width_px: deviation of the lines (Gaussian), or the shape's own unit.
        width_log_sigma: deviation of the logarithm of the width; 0: it is known, inf: nothing is.
            By default next to nothing: a belief that is off makes faint lines' deviations
            dishonest.
        reach: half a window, in starting widths. A Gaussian keeps 0.9989 of its information in 4.
        background: what the background is within a window.
        shape_error: error of each pixel's light as a part of it, deviation, another in each
            pixel: uneven pixels. A line of another shape than E is no such thing: a bright one
            is taken for several peaks, whatever is allowed here. Measure its shape
            (``LineSpreadFunction.from_cells``), or set ``further_peaks`` to False.
        max_joint_peaks: largest number of peaks that are fitted together, 1 to MAX_JOINT_PEAKS.
        false_split_rate: probability of fitting two peaks where there is one.
        further_peaks: more peaks than candidates are tried. If not, candidates that overlap are
            still fitted together, but a misfit is only flagged: right where the lines' shape is
            not known well enough for a misfit to tell of a second line.
        widen_misfit: a significant misfit widens the standard deviations.

    Raises:
        InvalidParameter: a value outside its range.
    """

    search: CentroidSettings = field(default_factory=lambda: CentroidSettings(min_width_px=1))
    width_px: float = 1.0
    width_log_sigma: float = 2.0
    reach: float = 4.0
    background: BackgroundModel = "surrounding-slope"
    shape_error: float = 0.0
    max_joint_peaks: int = MAX_JOINT_PEAKS
    false_split_rate: float = 1e-4
    further_peaks: bool = True
    widen_misfit: bool = True

    def __post_init__(self) -> None:
        require_between("width_px", self.width_px, *WIDTH_LIMITS_PX)
        sigma = self.width_log_sigma
        require(sigma == 0.0 or sigma >= 1e-6, "be zero, or 1e-6 or more", width_log_sigma=sigma)
        require_between("reach", self.reach, 2.0, 8.0)
        require_between("shape_error", self.shape_error, 0.0, 0.5)
        require_integer("max_joint_peaks", self.max_joint_peaks, 1, MAX_JOINT_PEAKS)
        require_between("false_split_rate", self.false_split_rate, 1e-12, 0.1)
        require_choice("background", self.background, get_args(BackgroundModel))

    @property
    def narrow_width_px(self) -> float:
        """Width about which, and below, widths become improbable; see *Prior*."""
        if self.width_log_sigma == np.inf:
            return NARROW_PX
        return min(NARROW_PX, 0.5 * self.width_px)

    @property
    def split_margin(self) -> float:
        """Excess over Schwarz's term by which a further peak must improve the fit."""
        return 2.0 * log(1.0 / self.false_split_rate)

    def chi2_limits(self) -> NDArray[np.float64]:
        """Return the critical chi-square at ``false_split_rate``, by degrees of freedom.

        Shape (MAX_WINDOW_PX + 1,), from none; none has no limit.
        """
        limits = np.full(MAX_WINDOW_PX + 1, np.inf)
        limits[1:] = chi2.isf(self.false_split_rate, np.arange(1, MAX_WINDOW_PX + 1))
        return limits

    def noise_chi2(self) -> NDArray[np.float64]:
        """Return the chi-square whose excess widens, by degrees of freedom; as ``chi2_limits``."""
        limits = np.full(MAX_WINDOW_PX + 1, np.inf)
        if self.widen_misfit:
            limits[1:] = chi2.isf(MISFIT_RATE, np.arange(1, MAX_WINDOW_PX + 1))
        return limits

    def variance_factor(
        self, misfit: NDArray[np.float64], dof: NDArray[np.int64]
    ) -> NDArray[np.float64]:
        """Return the factor on the covariance of fits; see *Misfit*.

        Args:
            misfit: their chi-squares.
            dof: their degrees of freedom.
        """
        excess = misfit - self.noise_chi2()[np.maximum(dof, 0)]
        return np.asarray(1.0 + np.maximum(excess, 0.0) / np.maximum(dof, 1))
