"""Cache of plans and their plots; few are computed at once, each only once."""

from collections.abc import Callable, Hashable
from pathlib import Path
from threading import Lock
from typing import Final, Generic, TypeVar

from cachetools import FIFOCache

from compute.planning.plan import plan
from compute.planning.plan_result import Plan
from service.api.concurrency_limit import ConcurrencyLimit
from service.api.devices.profiles import find_profile, posted_profile, profile_text

MAX_CONCURRENT: Final = 2
"""Plans worked out at the same time: they are work of seconds, and threads are for all."""

MAX_CACHED: Final = 64

Result = TypeVar("Result")


class ResultCache(Generic[Result]):
    """The newest results of computations that take seconds; few are computed at once.

    Args:
        limit: entered while a result is computed.
        kept: how many results.
    """

    def __init__(self, limit: ConcurrencyLimit, kept: int) -> None:
        self._limit = limit
        self._found: FIFOCache[Hashable, Result] = FIFOCache(kept)
        self._lock = Lock()

    def get(self, key: Hashable, work: Callable[[], Result]) -> Result:
        """Return the cached result of a key, or compute it.

        Raises:
            Busy: as many are being computed as may be.
        """
        with self._lock:
            if key in self._found:
                return self._found[key]
        with self._limit:
            result = work()
        with self._lock:
            self._found[key] = result
        return result


_BUSY: Final = f"{MAX_CONCURRENT} plans are being computed; ask for this one again in a few seconds"
_plans = ResultCache[Plan](ConcurrencyLimit(MAX_CONCURRENT, _BUSY), MAX_CACHED)
_pictures = ResultCache[bytes](ConcurrencyLimit(MAX_CONCURRENT, _BUSY), MAX_CACHED)


def cached_plan(name: str, profiles_dir: Path, grid: int) -> Plan:
    """Return the plan of a profile.

    Raises:
        UnknownDeviceProfile: there is none of this name.
        InvalidParameter: its file is not a profile, or no plan can be made of it.
        Busy: as many plans as may be are being worked out.
    """
    profile = find_profile(name, profiles_dir)
    # By what the file says, which may change.
    key = profile_text(name, profiles_dir), grid
    return _plans.get(key, lambda: plan(profile, grid=grid))


def posted_plan(text: str, grid: int) -> Plan:
    """Return the plan of a profile that a client sent.

    Raises:
        InvalidParameter: it is not a profile, or no plan can be made of it.
        Busy: as many plans as may be are being worked out.
    """
    profile = posted_profile(text)
    return _plans.get((text, grid), lambda: plan(profile, grid=grid))


def cached_plot(name: str, profiles_dir: Path, grid: int) -> bytes:
    """Return the picture of a plan as PNG.

    Raises:
        UnknownDeviceProfile, InvalidParameter, Busy: as ``plan_of``.
    """
    found = cached_plan(name, profiles_dir, grid)

    def draw() -> bytes:
        # Matplotlib is loaded by who wants a picture.
        from service.api.planning.plot import draw_plan

        return draw_plan(found)

    return _pictures.get((profile_text(name, profiles_dir), grid), draw)
