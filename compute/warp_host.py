"""Host side of the Warp kernels: device, memory of arrays, CPU threads."""

import ctypes
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache, partial
from operator import attrgetter
from typing import Any, Self

from numpy.typing import NDArray

from compute.errors import InvalidParameter


def suppress_greeting(wp: Any) -> None:
    """Let Warp log only warnings: its greeting would stand in a command's output."""
    wp.config.log_level = max(wp.config.log_level, wp.LOG_WARNING)


def warp_device(wp: Any, name: str | None) -> Any:
    """Return Warp's device of this name; None takes the first CUDA device, or else the CPU.

    Args:
        wp: the module, which loads too slowly to be imported here.
        name: "cpu", "cuda:0", ...

    Raises:
        InvalidParameter: there is no such device.
    """
    suppress_greeting(wp)
    if name is None:
        name = "cuda:0" if wp.is_cuda_available() else "cpu"
    try:
        return wp.get_device(name)
    except (ValueError, RuntimeError) as error:
        there = ", ".join(str(device.alias) for device in wp.get_devices())
        raise InvalidParameter(
            f"there is no device {name!r}; there are: {there}", device=name
        ) from error


def host_memory(array: Any) -> NDArray[Any]:
    """Return the memory of a Warp array on the host, not a copy of it."""
    view: NDArray[Any] = array.numpy()
    return view


address: Callable[[NDArray[Any]], int] = attrgetter("ctypes.data")
"""Returns the memory address of an array."""


class PackedLaunch:
    """A launch of a kernel on the CPU whose arguments stay packed from call to call.

    Warp packs them at each launch, which takes longer than a kernel takes for one frame.

    Args:
        launch: recorded by ``warp.launch(..., device="cpu", record_cmd=True)``.
    """

    def __init__(self, launch: Any) -> None:
        self._launch = launch
        _, *values = launch.params
        names = [argument.label for argument in launch.kernel.adj.args]
        fields = [(name, type(value)) for name, value in zip(names, values, strict=True)]
        packed = type("Arguments", (ctypes.Structure,), {"_fields_": fields})
        self.arguments: Any = packed(*values)
        """The kernel's arguments by name, to be changed between calls."""
        self._dim: int | None = None
        self._prepare()

    @classmethod
    def of_record(cls, kernel: Any, record: NDArray[Any]) -> Self:
        """Return the launch of a kernel with one thread, which takes the address of a record.

        Loads the kernel now, not at the first call, and compiles it unless an earlier process has.

        Args:
            kernel: made by ``native_kernel``.
            record: is to be kept alive by the caller.
        """
        # Here and not above: Warp takes a second to load.
        import warp as wp

        inputs = [address(record)]
        return cls(wp.launch(kernel, dim=1, inputs=inputs, device="cpu", record_cmd=True))

    def set_dim(self, dim: int) -> None:
        """Set the number of threads, where it is another: it takes as long as a kernel."""
        if dim != self._dim:
            self._launch.set_dim(dim)
            self._dim = dim
            self._prepare()

    def _prepare(self) -> None:
        bounds = ctypes.byref(self._launch.params[0])
        self.run = partial(self._launch.hooks.forward, bounds, ctypes.byref(self.arguments))
        """Runs the kernel."""


@cache
def worker_threads() -> ThreadPoolExecutor:
    """Return the threads that help the caller's: one for each further CPU."""
    return ThreadPoolExecutor(max(cpus() - 1, 1), thread_name_prefix="kernel")


@cache
def cpus() -> int:
    """Return the number of CPUs that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def check_threads(threads: int | None) -> int:
    """Return how many threads share a batch; None: as many as there are CPUs.

    Raises:
        InvalidParameter: fewer than one.
    """
    if threads is None:
        return cpus()
    if threads < 1:
        raise InvalidParameter(f"threads is {threads}; it must be 1 or more", threads=threads)
    return threads
