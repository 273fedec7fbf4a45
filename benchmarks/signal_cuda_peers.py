"""Peers of the peak benchmark on CUDA: CuPy arrays, ReductionKernel, torch.compile."""

from collections.abc import Callable
from typing import Any

Peer = tuple[str, Callable[[], Any]]


def cupy_peers(lines: Any) -> list[Peer]:
    """Return the methods of CuPy on lines of the host, which are copied to the device here."""
    import cupy as cp

    on_device = cp.asarray(lines)
    index = cp.arange(lines.shape[1], dtype=cp.float32)[None]

    def by_arrays() -> Any:
        values = on_device.astype(cp.float32)
        background = values[:, ::64].min(axis=1, keepdims=True)
        cut = background + (values.max(axis=1, keepdims=True) - background) / 3
        weights = cp.maximum(values - cut, 0)
        return (weights * index).sum(axis=1) / weights.sum(axis=1)

    maximum = cp.ReductionKernel("uint16 v", "uint16 m", "v", "max(a, b)", "m = a", "0", "most")
    # Sum and moment in one pass, as the parts of a complex number.
    moments = cp.ReductionKernel(
        "uint16 v, float32 cut, float32 i",
        "complex64 s",
        "v > cut ? complex<float>(v - cut, (v - cut) * i) : complex<float>(0, 0)",
        "a + b",
        "s = a",
        "complex<float>(0, 0)",
        "moments",
    )

    def by_reduction_kernel() -> Any:
        background = on_device[:, ::64].min(axis=1).astype(cp.float32)
        cut = background + (maximum(on_device, axis=1) - background) / 3
        sums = moments(on_device, cut[:, None], index, axis=1)
        return sums.imag / sums.real

    return [("CuPy arrays", by_arrays), ("CuPy ReductionKernel", by_reduction_kernel)]


def torch_peers(lines: Any) -> list[Peer]:
    """Return torch.compile's fused formulation on lines of the host, copied to the device here."""
    import torch

    # PyTorch computes little with uint16; below 32768 counts int16 is the same.
    on_device = torch.from_numpy(lines.view("int16")).cuda()
    index = torch.arange(lines.shape[1], dtype=torch.float32, device="cuda")[None]

    @torch.compile  # type: ignore[untyped-decorator]
    def fused(values: Any) -> Any:
        light = values.to(torch.float32)
        background = light[:, ::64].amin(dim=1, keepdim=True)
        cut = background + (light.amax(dim=1, keepdim=True) - background) / 3
        weights = torch.relu(light - cut)
        return (weights * index).sum(dim=1) / weights.sum(dim=1)

    return [("torch.compile", lambda: fused(on_device))]


def copy_bytes_per_s(gigabytes: float = 2.0, repeats: int = 10) -> float:
    """Return the bandwidth of a copy on the device, bytes read plus bytes written [B/s]."""
    import torch

    source = torch.empty(int(gigabytes * 2**30), dtype=torch.uint8, device="cuda")
    source.random_(0, 255)
    target = torch.empty_like(source)
    best = float("inf")
    start, end = torch.cuda.Event(enable_timing=True), torch.cuda.Event(enable_timing=True)
    for _ in range(repeats):
        start.record()
        target.copy_(source)
        end.record()
        end.synchronize()
        best = min(best, start.elapsed_time(end))
    return 2.0 * float(source.numel()) / (best * 1e-3)


def synchronize() -> None:
    """Wait for the device."""
    import torch

    torch.cuda.synchronize()
