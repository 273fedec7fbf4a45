"""Self-calibration requests: wands, rigid bodies and frames at unknown positions."""

from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from compute.calibration.bundle_adjustment.target_shape import KnownDistance
from compute.calibration.self_calibration.targets import (
    Recording,
    RigidBody,
    UnknownRigidBody,
    Wand,
)
from compute.errors import InvalidParameter, ReadingOutsideSensor, UnknownSensor
from hardware.driver import SensorDescription
from service.api.base_models import FIRST_ERROR_ONLY, Note, Position, RequestModel, Slug
from service.api.calibrations.schema import GivenDistortion, SensorName

MAX_POSES = 5_000
MAX_MARKERS = 64

Length = Annotated[float, Field(gt=0, le=1e6, description="[mm]")]
Deviation = Annotated[float, Field(ge=0, le=1e3, description="[mm]")]
MarkerReadings = Annotated[
    dict[SensorName, Annotated[list[float | None], Field(max_length=MAX_MARKERS)]],
    Field(
        max_length=64,
        description="By sensor: the peak of each marker [px], null where it was not seen. Leave "
        "out sensors that saw none.",
    ),
]


class WandTarget(RequestModel):
    """Markers on a line at known places."""

    kind: Literal["wand"]
    position_mm: Annotated[
        list[Annotated[float, Field(ge=-1e6, le=1e6)]],
        Field(max_length=MAX_MARKERS, description="Of the markers along the wand [mm]."),
    ]
    sigma_mm: Deviation = 0.0


class BodyTarget(RequestModel):
    """A rigid body, or calibration frame, of known shape."""

    kind: Literal["rigid-body"]
    marker_mm: Annotated[list[Position], Field(max_length=MAX_MARKERS)]
    sigma_mm: Deviation = 0.0


class UnknownTarget(RequestModel):
    """A rigid body of unknown shape, with one known distance for the scale."""

    kind: Literal["unknown-body"]
    markers: Annotated[int, Field(ge=1, le=MAX_MARKERS)]
    first: Annotated[int, Field(ge=1, le=MAX_MARKERS, description="Marker, counted from 1.")]
    second: Annotated[int, Field(ge=1, le=MAX_MARKERS, description="Marker, counted from 1.")]
    length_mm: Length
    sigma_mm: Deviation = 0.0


class NewRecording(RequestModel):
    """One target, held or waved, and what the sensors read of it."""

    target: Annotated[WandTarget | BodyTarget | UnknownTarget, Field(discriminator="kind")]
    poses: Annotated[list[MarkerReadings], Field(max_length=MAX_POSES), FIRST_ERROR_ONLY]
    sigma_px: Annotated[float, Field(ge=1e-6, le=1e4)] | None = Field(
        default=None, description="Standard deviation of the readings; null: from the residuals."
    )


class NewSelfCalibrationRun(RequestModel):
    """Recordings without known coordinates, from which a device is calibrated."""

    id: Slug | None = Field(default=None, description="The run's; left out: the server's choice.")
    device_id: Slug
    start_calibration_id: Slug | None = Field(
        default=None,
        description="A calibration that is near, with whose terms of distortion; left out: the "
        "active one, or none with `initial` `readings`.",
    )
    initial: Literal["start", "readings"] = Field(
        default="start",
        description="`readings`: initial cameras are computed from a wand's readings, of four "
        "sensors or more; a `start_calibration_id` then gives the frame, and which of two mirror "
        "images is right.",
    )
    directions_deg: (
        Annotated[dict[SensorName, Annotated[float, Field(ge=-360, le=360)]], Field(max_length=64)]
        | None
    ) = Field(
        default=None,
        description="Without a start: the direction in which each sensor's readings grow, clockwise"
        " from the right, seen from the device towards the scene, to 20 degrees. It settles which "
        "of two mirror images is right.",
    )
    distortion: GivenDistortion = Field(
        default="none",
        description="Without a start: the name of a set of terms, or the terms; not `auto`.",
    )
    result_id: Slug | None = Field(
        default=None, description="Of the calibration to be made; left out: the server's choice."
    )
    recordings: Annotated[list[NewRecording], Field(min_length=1, max_length=16)]
    datum: Literal["start", "first-pose"] = Field(
        default="start",
        description="The world's frame: of the start, or of the first recording's body where it "
        "was first seen.",
    )
    note: Note = ""


def directions_of(
    given: dict[str, float] | None, sensors: list[SensorDescription]
) -> list[float] | None:
    """Return the directions of the sensors' pixels in their order [degrees]; None: not given.

    Raises:
        UnknownSensor: a direction is of a sensor that the device has not got.
        InvalidParameter: a sensor has no direction.
    """
    if given is None:
        return None
    names = [sensor.name for sensor in sensors]
    for name in given:
        if name not in names:
            raise UnknownSensor(
                f'directions_deg has sensor "{name}", which the device does not have; its sensors '
                f"are {', '.join(names)}",
                sensor=name,
            )
    for name in names:
        if name not in given:
            raise InvalidParameter(
                f'directions_deg has no sensor "{name}"; give one for each of {", ".join(names)}',
                sensor=name,
            )
    return [given[name] for name in names]


def recording_of(given: NewRecording, sensors: list[SensorDescription]) -> Recording:
    """Return a recording for the computation.

    Raises:
        UnknownSensor: a reading's sensor is not one of the device's.
        ReadingOutsideSensor: a reading lies outside its sensor's pixels.
        InvalidParameter: a pose has more or fewer readings than the target has markers.
    """
    target = given.target
    found: Wand | RigidBody | UnknownRigidBody
    if isinstance(target, WandTarget):
        markers, found = (
            len(target.position_mm),
            Wand(tuple(target.position_mm), target.sigma_mm),
        )
    elif isinstance(target, BodyTarget):
        markers = len(target.marker_mm)
        found = RigidBody(tuple(target.marker_mm), target.sigma_mm)
    else:
        markers = target.markers
        distance = KnownDistance(
            target.first - 1, target.second - 1, target.length_mm, target.sigma_mm
        )
        found = UnknownRigidBody(markers, distance)
    columns = {sensor.name: index for index, sensor in enumerate(sensors)}
    readings = np.full((len(given.poses), markers, len(sensors)), np.nan)
    for row, pose in enumerate(given.poses):
        for name, values in pose.items():
            if name not in columns:
                raise UnknownSensor(
                    f'pose {row + 1} has readings of sensor "{name}", which the device does not '
                    f"have; its sensors are {', '.join(columns)}",
                    sensor=name,
                )
            if len(values) != markers:
                raise InvalidParameter(
                    f'pose {row + 1} has {len(values)} readings of sensor "{name}"; the target '
                    f"has {markers} markers: give null for one that was not seen",
                    sensor=name,
                )
            column = columns[name]
            read = np.array([np.nan if one is None else one for one in values], dtype=np.float64)
            last = sensors[column].pixels - 0.5
            outside = read[(read < -0.5) | (read > last)]
            if len(outside):
                raise ReadingOutsideSensor(
                    f"the reading {outside[0]:g} px of pose {row + 1} lies outside sensor "
                    f'"{name}", whose pixels reach from -0.5 to {last:g} px',
                    sensor=name,
                )
            readings[row, :, column] = read
    sigma = None if given.sigma_px is None else np.full(readings.shape, given.sigma_px)
    return Recording(found, readings, sigma)
