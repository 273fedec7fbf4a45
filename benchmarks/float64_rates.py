"""Float64 throughput and memory bandwidth of a CUDA device."""

import time
from collections.abc import Callable
from dataclasses import dataclass

import warp as wp

# As the ray kernel: a multiplication and an addition are two operations, not one fused.
wp.set_module_options({"enable_backward": False, "fast_math": False, "fuse_fp": False})

CHAINS, ROUNDS = 8, 2000
"""Operations that do not wait for one another, and rounds of them."""
THREADS = 1 << 18
COPY_WORDS = 1 << 27


@dataclass(frozen=True)
class Float64Rates:
    """Measured rates of a device.

    Args:
        adds_per_s: additions and multiplications, not fused.
        divisions_per_s: divisions.
        roots_per_s: square roots.
        bytes_per_s: bytes of memory read and written, of a copy of 1 GiB.
    """

    adds_per_s: float
    divisions_per_s: float
    roots_per_s: float
    bytes_per_s: float


_CHAINS = f"""
    double v[{CHAINS}];
    const double a = 0.999999, b = 1e-9 * thread;
    for (int i = 0; i < {CHAINS}; ++i) v[i] = 1.0 + 0.1 * i + b;
    if (kind == 0)
        for (int r = 0; r < {ROUNDS}; ++r)
            for (int i = 0; i < {CHAINS}; ++i) v[i] = v[i] * a + b;
    else if (kind == 1)
        for (int r = 0; r < {ROUNDS}; ++r)
            for (int i = 0; i < {CHAINS}; ++i) v[i] = (1.5 + b) / v[i];
    else
        for (int r = 0; r < {ROUNDS}; ++r)
            for (int i = 0; i < {CHAINS}; ++i) v[i] = sqrt(v[i]);
    double sum = 0.0;
    for (int i = 0; i < {CHAINS}; ++i) sum += v[i];
    ((double*)sums_address)[thread] = sum;
"""


@wp.func_native(_CHAINS)  # type: ignore[untyped-decorator]
def _run_chains(thread: int, kind: int, sums_address: wp.uint64) -> None: ...


@wp.kernel
def _chains(kind: int, sums_address: wp.uint64) -> None:
    _run_chains(wp.tid(), kind, sums_address)


def float64_rates(device: str) -> Float64Rates:
    """Measure a CUDA device; each rate is the best of five."""
    sums = wp.zeros(THREADS, dtype=wp.float64, device=device)
    source = wp.zeros(COPY_WORDS, dtype=wp.float64, device=device)
    target = wp.zeros(COPY_WORDS, dtype=wp.float64, device=device)

    def chains(kind: int) -> float:
        return _best_s(
            device,
            lambda: wp.launch(_chains, THREADS, [kind, sums.ptr], device=device, block_dim=256),
        )

    each = THREADS * CHAINS * ROUNDS
    return Float64Rates(
        adds_per_s=2.0 * each / chains(0),
        divisions_per_s=each / chains(1),
        roots_per_s=each / chains(2),
        bytes_per_s=2.0 * 8.0 * COPY_WORDS / _best_s(device, lambda: wp.copy(target, source)),
    )


def _best_s(device: str, call: Callable[[], object]) -> float:
    call()
    wp.synchronize_device(device)
    times = []
    for _ in range(5):
        start = time.perf_counter()
        call()
        wp.synchronize_device(device)
        times.append(time.perf_counter() - start)
    return min(times)
