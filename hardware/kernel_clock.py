"""Uncertainty of the host's clock where PTP or NTP synchronises it, as the kernel states it.

chronyd, ntpd and others tell the kernel how well they know the time (``adjtimex``); programs read
it there, whichever of them runs. Beside it stands ``hardware.round_trip_clock``, for hosts without.
"""

import ctypes
import math
import sys
from collections.abc import Callable
from typing import Final

UNSYNCHRONISED: Final = 0x0040
"""STA_UNSYNC of the kernel's status."""


class Timex(ctypes.Structure):
    """First members of the kernel's ``struct timex``, and room for the others."""

    _fields_ = (
        ("modes", ctypes.c_uint),
        ("offset", ctypes.c_long),
        ("frequency", ctypes.c_long),
        ("max_error_us", ctypes.c_long),
        ("estimated_error_us", ctypes.c_long),
        ("status", ctypes.c_int),
        ("others", ctypes.c_byte * 256),
    )


def _ask(timex: Timex) -> int:
    """Read the kernel's clock; return its state, -1: it does not tell."""
    if not sys.platform.startswith("linux"):
        return -1
    try:
        state: int = ctypes.CDLL(None, use_errno=True).adjtimex(ctypes.byref(timex))
    except (AttributeError, OSError):
        return -1
    return state


def kernel_clock_sigma_ns(ask: Callable[[Timex], int] = _ask) -> float | None:
    """Return the standard deviation of the host's clock against true time [ns].

    Args:
        ask: fills a ``Timex`` and returns the kernel's state.

    Returns:
        As estimated by what synchronises it; where that states only the largest error, as of any
        place within it. None: nothing synchronises it, or the system does not tell.
    """
    timex = Timex(modes=0)
    if ask(timex) < 0 or timex.status & UNSYNCHRONISED:
        return None
    if timex.estimated_error_us > 0:
        return 1e3 * float(timex.estimated_error_us)
    return 1e3 * float(timex.max_error_us) / math.sqrt(3.0)
