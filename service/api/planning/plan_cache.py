"""Works out plans for requests: a few at once, and each only once."""

from collections.abc import Callable, Hashable
from pathlib import Path
from threading import BoundedSemaphore, Lock
from typing import Final, Generic, TypeVar

from compute.planning.plan import plan
from compute.planning.plan_result import Plan
from service.api.devices.profiles import find_profile, profile_text
from service.problems.errors import Busy

MAX_CONCURRENT: Final = 2
"""Plans worked out at the same time: they are work of seconds, and threads are for all."""

MAX_CACHED: Final = 64

Result = TypeVar("Result")


class ResultCache(Generic[Result]):
    """Results of work of seconds: the latest are kept, and few are worked out at once.

    Args:
        slots: taken while a result is worked out.
        kept: how many results.
    """

    def __init__(self, slots: BoundedSemaphore, kept: int) -> None:
        self._slots = slots
        self._kept = kept
        self._found: dict[Hashable, Result] = {}
        self._lock = Lock()

    def get(self, key: Hashable, work: Callable[[], Result]) -> Result:
        """Return what was worked out under a key, or work it out.

        Raises:
            Busy: all slots are taken.
        """
        with self._lock:
            if key in self._found:
                return self._found[key]
        if not self._slots.acquire(blocking=False):
            raise Busy(
                f"{MAX_CONCURRENT} plans are being worked out; ask for this one again in a few seconds"
            )
        try:
            result = work()
        finally:
            self._slots.release()
        with self._lock:
            self._found[key] = result
            while len(self._found) > self._kept:
                del self._found[next(iter(self._found))]  # the oldest
        return result


_plans = ResultCache[Plan](BoundedSemaphore(MAX_CONCURRENT), MAX_CACHED)
_pictures = ResultCache[bytes](BoundedSemaphore(MAX_CONCURRENT), MAX_CACHED)


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
