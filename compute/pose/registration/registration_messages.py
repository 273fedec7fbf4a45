"""Warnings of a registration by paired points, in words."""

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2 as chi_square

from compute.pose.registration.correspondence_errors import CorrespondenceErrors

Array = NDArray[np.float64]

_NEARLY: Final = 0.1
_MISFIT: Final = 1e-3


def misfit_messages(
    chi2: float | None, dof: int, errors: CorrespondenceErrors | None, names: Sequence[str]
) -> list[str]:
    """Return a warning of correspondence errors, or of residuals that nothing explains.

    Args:
        chi2: chi2 of the residuals; None: the covariances are unknown.
        dof: its degrees of freedom.
        errors: correspondence errors that were found; None: none.
        names: names of the N fiducials.
    """
    if errors is not None:
        called = ", ".join(f'"{names[one]}"' for one in errors.pairs)
        mended = f"the RMS residual falls from {errors.rms_before_mm:.3g} to"
        if errors.kind == "exchanged":
            goes = ", ".join(
                f'"{names[one]}" to "{names[errors.order[one]]}"' for one in errors.pairs
            )
            return [
                (
                    f"fiducials {called} are exchanged: {mended} {errors.rms_after_mm:.3g} mm with "
                    f"{goes}"
                )
            ]
        one = len(errors.pairs) == 1
        return [
            (
                f"{f'fiducial {called} is' if one else f'fiducials {called} are'} not where "
                f"{'it' if one else 'they'} should be: {mended} "
                f"{errors.rms_after_mm:.3g} mm without {'it' if one else 'them'}"
            )
        ]
    if chi2 is not None and chi_square.sf(chi2, dof) < _MISFIT:
        return [
            (
                f"the residuals are {np.sqrt(chi2 / dof):.3g} of their deviations, which noise "
                f"makes in less than one of {1.0 / _MISFIT:.0f}, and no exchange or leaving out "
                "mends it: the covariances are too small, or something moved"
            )
        ]
    return []


def symmetry_messages(
    others: tuple[tuple[int, ...], ...], errors: CorrespondenceErrors | None, names: Sequence[str]
) -> list[str]:
    """Return a warning where an exchange of fiducials would not show.

    Args:
        others: orders of the targets that fit as well as the given one.
        errors: correspondence errors that were found; None: none.
        names: names of the N fiducials.
    """
    if errors is not None or not others:
        return []
    moved = [one for one, goal in enumerate(others[0]) if one != goal]
    called = ", ".join(f'"{names[one]}"' for one in moved)
    return [
        (
            f"fiducials {called} are placed so that they fit as well in another order: an exchange "
            "would not be seen; one more fiducial away from their symmetry would show it"
        )
    ]


def collinearity_messages(along: float, off: float, covariance: Array, known: bool) -> list[str]:
    """Return a warning where fiducials are nearly collinear.

    Args:
        along: RMS spread of the fiducials along their principal line [mm].
        off: RMS distance from this line [mm].
        covariance: covariance of rotation [rad] and translation [mm], shape (6, 6) or more.
        known: whether it comes from given covariances, not from the residuals.
    """
    if off >= _NEARLY * along:
        return []
    turn = float(np.sqrt(np.linalg.eigvalsh(covariance[:3, :3])[-1]))
    told = "" if known else ", by what the residuals tell"
    return [
        (
            f"the fiducials are only {off:.3g} mm RMS off one line, along which they are spread "
            f"by {along:.4g} mm: the turn about it is known to {np.degrees(turn):.2g} deg{told}, "
            f"and a target {along:.3g} mm from the line is {turn * along:.2g} mm off for it"
        )
    ]
