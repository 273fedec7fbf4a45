"""Registration by a surface (ICP): refines an earlier one by points on the surface."""

import hashlib
import time
from collections.abc import Callable
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from compute.errors import HighError, InvalidParameter
from compute.pose.registration.icp import (
    IcpRegistration,
    IcpSettings,
    register_surface,
)
from compute.pose.registration.surface import PointCloud, Surface, TriangleMesh
from compute.transform import Transform
from service.api.tools.registration_schema import NewSurface
from service.api.tools.registrations import target_errors
from service.api.tools.surface_schema import MeshInput, PointCloudInput
from service.settings import Settings

Array = NDArray[np.float64]

MAX_S: Final = 60.0
"""A registration takes about a second; one that takes as long keeps a core from others."""
_LOOSE: Final = 0.01
"""A motion held by less is told of: its deviation is more than ten times that of the best."""


def check_size(request: NewSurface, settings: Settings) -> None:
    """Refuse more points, or a larger surface, than the settings allow; raises InvalidParameter."""
    given = request.surface
    counts = {"points_mm": (len(request.points_mm), "surface_points")}
    if isinstance(given, MeshInput):
        counts["surface.vertices_mm"] = (len(given.vertices_mm), "surface_size")
        counts["surface.triangles"] = (len(given.triangles), "surface_size")
    else:
        counts["surface.points_mm"] = (len(given.points_mm), "surface_size")
    for name, (count, setting) in counts.items():
        most = getattr(settings, setting)
        if count > most:
            raise InvalidParameter(
                f"{name} has {count} items; this server takes {most} (its setting {setting}): send "
                "fewer, evenly from all",
                items=count,
                most=most,
            )


def refine_by_surface(
    request: NewSurface, frame_from_measured: Transform, max_s: float = MAX_S
) -> dict[str, Any]:
    """Return what points on a surface make of an earlier registration, as it is stored.

    Args:
        request: with points and surface.
        frame_from_measured: the earlier registration, to the frame from where points were
            measured.
        max_s: how long it may take [s].

    Raises:
        TooFewPoints, UndeterminedParameters, HighError, NoConvergence, InvalidParameter: as
            ``register_surface``; HighError also of what lies too far from the start.
    """
    points = np.array(request.points_mm, dtype=np.float64)
    arrays = _arrays(request.surface)
    mesh = isinstance(request.surface, MeshInput)
    surface: Surface = TriangleMesh(*arrays) if mesh else PointCloud(*arrays)
    found = register_surface(
        points,
        surface,
        frame_from_measured,
        IcpSettings(
            trim=request.trim,
            max_rms_mm=request.max_rms_mm,
            start_turn_rad=float(np.radians(request.initial_rotation_tolerance_deg)),
            start_shift_mm=request.initial_shift_tolerance_mm,
        ),
        _within(max_s),
    )
    back = found.transform.inverse()
    assert back.covariance is not None
    middle = points.mean(axis=0)
    moved = found.transform.difference(frame_from_measured)
    rotation_deg = float(np.degrees(np.linalg.norm(moved[:3])))
    shifted = found.transform.apply(middle) - frame_from_measured.apply(middle)
    shifted_mm = float(np.linalg.norm(shifted))
    _check_near(request, rotation_deg, shifted_mm)
    other = found.other
    return {
        "matrix": back.matrix.tolist(),
        "covariance": back.covariance.tolist(),
        "surface": {
            "rms_mm": found.rms_mm,
            "iterations": found.steps,
            "points": int(found.kept.sum()),
            "distance_mm": found.distance_mm.tolist(),
            "used": found.kept.tolist(),
            "stiffness_ratio": found.stiffness_ratio,
            "weakest_motion": found.weakest_motion,
            "rotation_deg": rotation_deg,
            "shift_mm": shifted_mm,
            "alternative": None
            if other is None
            else {"matrix": other.inverse().matrix.tolist(), "rms_mm": found.other_rms_mm},
        },
        "targets": target_errors(request.targets, back),
        "warnings": _warnings(found),
    }


def _within(max_s: float) -> Callable[[], None]:
    """Return a callable that raises InvalidParameter once a time limit [s] has passed."""
    end = time.monotonic() + max_s

    def check() -> None:
        if time.monotonic() >= end:
            raise InvalidParameter(
                f"the points were not brought onto the surface within {max_s:g} s; send fewer "
                "points, a coarser surface, or a better start"
            )

    return check


def stored_request(request: NewSurface) -> dict[str, Any]:
    """Return the request as it is stored: the surface replaced by its size and hash."""
    given = request.surface
    arrays = _arrays(given)
    summary = {
        "kind": given.kind,
        "vertices": len(arrays[0]),
        "triangles": len(given.triangles) if isinstance(given, MeshInput) else None,
        "sha256": hashlib.sha256(b"".join(one.tobytes() for one in arrays)).hexdigest(),
    }
    return request.model_dump(mode="json", exclude={"note", "surface"}) | {"surface": summary}


def _arrays(given: MeshInput | PointCloudInput) -> list[NDArray[Any]]:
    """Return a surface's arrays: vertices, then triangles or normals."""
    if isinstance(given, MeshInput):
        return [np.array(given.vertices_mm, "<f8"), np.array(given.triangles, "<i8")]
    points = np.array(given.points_mm, "<f8")
    return (
        [points]
        if given.normals is None
        else [points, np.array(given.normals, "<f8").reshape(-1, 3)]
    )


def _warnings(found: IcpRegistration) -> list[str]:
    told = []
    if found.stiffness_ratio < _LOOSE:
        told.append(
            f"the points hardly hold {found.weakest_motion}: its deviation is "
            f"{found.stiffness_ratio**-0.5:.0f} times that of the best held motion; take points "
            "where the surface bends another way"
        )
    if found.other is not None and found.other_rms_mm is not None:
        told.append(
            f"the points lie about as well elsewhere, {found.other_rms_mm:.3g} mm RMS off the "
            f"surface, and {found.rms_mm:.3g} mm here: look whether this is the right one"
        )
    return told


def _check_near(request: NewSurface, rotation_deg: float, shifted_mm: float) -> None:
    """Refuse what lies further from the start than that may be off; raises HighError.

    The frame is in use from the answer on, and as far off other answers were not looked for.
    """
    for name, value, unit in (
        ("initial_rotation_tolerance_deg", rotation_deg, "degrees"),
        ("initial_shift_tolerance_mm", shifted_mm, "mm"),
    ):
        most = getattr(request, name)
        if most > 0.0 and value > most:
            raise HighError(
                f"the points lie on the surface {value:.3g} {unit} from where registration "
                f'"{request.parent_id}" puts them, and {name} is {most:g}: one of the two is '
                f"wrong; look which, or give a larger {name}",
                **{name: most, "found": value},
            )
