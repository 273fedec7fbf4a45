"""Benchmark of surface registration: ``python -m benchmarks.icp``.

Thread CPU time, of 500 points on a head-like mesh of 20 000 triangles, with and without other
starts; of reading the request, as the service does; and the request's size.
"""

import json
import time
from typing import Any, Final

import numpy as np

from compute.pose.registration.icp import IcpSettings, register_surface
from compute.pose.registration.surface import TriangleMesh
from compute.transform import Transform

POINTS: Final = 500
AROUND, ALONG = 100, 101


def head() -> tuple[np.ndarray[Any, Any], np.ndarray[Any, Any]]:
    """Return vertices and triangles of a closed body without symmetry [mm]."""
    turn, tilt = np.meshgrid(
        np.linspace(0.0, 2.0 * np.pi, AROUND, endpoint=False),
        np.linspace(0.02, np.pi - 0.02, ALONG),
        indexing="ij",
    )
    way = np.stack([np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), np.cos(tilt)], -1)
    x, y, z = np.moveaxis(way, -1, 0)
    size = 1.0 + 0.15 * x**3 + 0.2 * y * z + 0.1 * x * y
    vertices = (way * [60.0, 80.0, 110.0] * size[..., None]).reshape(-1, 3)
    first = np.arange(AROUND)[:, None] * ALONG + np.arange(ALONG - 1)
    beside = (first + ALONG) % (AROUND * ALONG)
    lower = np.stack([first, beside, first + 1], -1)
    upper = np.stack([beside, beside + 1, first + 1], -1)
    return vertices, np.concatenate([lower, upper]).reshape(-1, 3)


def main() -> None:
    """Measure and print."""
    vertices, faces = head()
    rng = np.random.default_rng(1)
    truth = Transform.from_rotation_vector(
        np.array([0.02, -0.03, 0.02]), np.array([2.0, -1.0, 3.0])
    )
    seen = vertices[vertices[:, 1] > 0.0]
    seen = seen[rng.choice(len(seen), POINTS)] + rng.normal(0.0, 0.3, (POINTS, 3))
    points = truth.inverse().apply(seen)
    surface = TriangleMesh(vertices, faces)
    print(f"{POINTS} points, {len(faces)} triangles")
    alone = IcpSettings(start_turn_rad=0.0, start_shift_mm=0.0)
    for name, icp_settings in (("one start", alone), ("all starts", IcpSettings())):
        register_surface(
            points[:50], surface, Transform.identity(), icp_settings
        )  # imports and caches
        begun = time.thread_time()
        found = register_surface(points, surface, Transform.identity(), icp_settings)
        took = time.thread_time() - begun
        print(
            f"{name:12s} {took:6.2f} s, {found.rms_mm:.2f} mm RMS, hold {found.stiffness_ratio:.3f}"
        )
    given = {
        "kind": "mesh",
        "vertices_mm": np.round(vertices, 3).tolist(),
        "triangles": faces.tolist(),
    }
    body = json.dumps(given)
    begun = time.thread_time()
    json.loads(body, object_pairs_hook=dict)
    np.array(json.loads(body)["vertices_mm"])
    print(f"{'reading JSON':12s} {time.thread_time() - begun:6.2f} s twice, {len(body)} bytes")
    print(f"triangles in 8 MiB: {8 * 2**20 / len(body) * len(faces):.0f}")


if __name__ == "__main__":
    main()
