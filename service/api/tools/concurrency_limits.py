"""Limits of how many requests observe a device at once, or compute in their thread."""

from typing import Final

from service.api.concurrency_limit import ConcurrencyLimit

MAX_CONCURRENT: Final = 4
"""Each takes one of the threads that all requests share, for as long as it waits."""
MAX_CONCURRENT_SURFACES: Final = 2
"""Each takes a core for up to some seconds."""

_MESSAGE: Final = (
    "{} are under way, as many as may at once; send this one again when one of them is done"
)

captures: Final = ConcurrencyLimit(
    MAX_CONCURRENT, _MESSAGE.format(f"{MAX_CONCURRENT} captures and calibrations of tools")
)
digitisations: Final = ConcurrencyLimit(
    MAX_CONCURRENT, _MESSAGE.format(f"{MAX_CONCURRENT} measurements of points")
)
"""Counted apart from captures: who may only read must not keep calibrations from their turn."""
surfaces: Final = ConcurrencyLimit(
    MAX_CONCURRENT_SURFACES, _MESSAGE.format(f"{MAX_CONCURRENT_SURFACES} registrations by surfaces")
)
