"""The benchmark traces the same rays by all ways, and its counts are of what is done."""

import numpy as np
import pytest

from benchmarks import ray_tracing
from compute.optics.tracing.reference_tracer import RayStatus, trace_rays
from compute.optics.tracing.surface_records import pack
from compute.optics.tracing.surfaces import Surface, SurfaceStack


def test_all_rays_arrive():
    found = trace_rays(ray_tracing.thesis_lens(), *ray_tracing.rays_to_lens(5000))
    assert (found.status == RayStatus.ARRIVED).mean() > 0.99


def test_rows(monkeypatch):
    monkeypatch.setattr(ray_tracing, "RAYS", 2000)
    rows = ray_tracing.run("cpu", seconds=0.0, peer=False)
    assert [row["method"] for row in rows] == ["numpy", "warp, trace()", "warp, rays on the device"]
    assert rows[0]["times_numpy"] == 1.0
    for row in rows:
        assert row["rays_per_s"] == pytest.approx(2000 / row["time_us"] * 1e6)


def test_operations_are_counted_surface_by_surface():
    """A plane that does not refract adds what its formulas say, and no more."""
    lens = ray_tracing.thesis_lens()
    plane = Surface(lens.image.shape, (0.0, 0.0, 20.0))
    more = SurfaceStack((*lens.surfaces, plane), lens.image)
    assert not pack(more)["refracts"][2]
    before, after = ray_tracing.operations_per_ray(lens), ray_tracing.operations_per_ray(more)
    added = {kind: after[kind] - before[kind] for kind in before}
    # Into its frame 3 and a quotient, the place 4, the path 2, out of the frame 3.
    assert added == {"adds": 12.0, "divisions": 1.0, "roots": 0.0}
    assert np.isclose(ray_tracing.BYTES_PER_RAY, 116.0)
