"""Self-calibration runs as clients send them: wands, bodies and frames at unknown places."""

from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from compute.calibration.adjustment.shape import KnownDistance
from compute.calibration.selfcalibration.subjects import (
    Recording,
    RigidBody,
    UnknownBody,
    Wand,
)
from compute.errors import InvalidParameter, ReadingOutsideSensor, UnknownSensor
from hardware.driver import SensorDescription
from service.calibrations.schema import SensorName
from service.schema import Given, Note, Position, Slug

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


class WandSubject(Given):
    """Markers on a line at known places."""

    kind: Literal["wand"]
    position_mm: Annotated[
        list[Annotated[float, Field(ge=-1e6, le=1e6)]],
        Field(max_length=MAX_MARKERS, description="Of the markers along the wand [mm]."),
    ]
    sigma_mm: Deviation = 0.0


class BodySubject(Given):
    """A rigid body, or calibration frame, of known shape."""

    kind: Literal["rigid-body"]
    marker_mm: Annotated[list[Position], Field(max_length=MAX_MARKERS)]
    sigma_mm: Deviation = 0.0


class UnknownSubject(Given):
    """A rigid body of unknown shape, with one known distance for the scale."""

    kind: Literal["unknown-body"]
    markers: Annotated[int, Field(ge=1, le=MAX_MARKERS)]
    first: Annotated[int, Field(ge=1, le=MAX_MARKERS, description="Marker, counted from 1.")]
    second: Annotated[int, Field(ge=1, le=MAX_MARKERS, description="Marker, counted from 1.")]
    length_mm: Length
    sigma_mm: Deviation = 0.0


class NewRecording(Given):
    """One subject, held or waved, and what the sensors read of it."""

    subject: Annotated[WandSubject | BodySubject | UnknownSubject, Field(discriminator="kind")]
    poses: Annotated[list[MarkerReadings], Field(max_length=MAX_POSES)]
    sigma_px: Annotated[float, Field(ge=1e-6, le=1e4)] | None = Field(
        default=None, description="Standard deviation of the readings; null: from the residuals."
    )


class NewSelfCalibrationRun(Given):
    """Recordings without known coordinates, from which a device is calibrated."""

    id: Slug | None = Field(default=None, description="The run's; left out: the server's choice.")
    device: Slug
    start: Slug | None = Field(
        default=None,
        description="A calibration that is near, with whose terms of distortion; left out: the "
        "active one.",
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


def recording_of(given: NewRecording, sensors: list[SensorDescription]) -> Recording:
    """Return a recording for the computation.

    Raises:
        UnknownSensor: a reading's sensor is not one of the device's.
        ReadingOutsideSensor: a reading lies outside its sensor's pixels.
        InvalidParameter: a pose has more or fewer readings than the subject has markers.
    """
    subject = given.subject
    found: Wand | RigidBody | UnknownBody
    if isinstance(subject, WandSubject):
        markers, found = (
            len(subject.position_mm),
            Wand(tuple(subject.position_mm), subject.sigma_mm),
        )
    elif isinstance(subject, BodySubject):
        markers = len(subject.marker_mm)
        found = RigidBody(tuple(subject.marker_mm), subject.sigma_mm)
    else:
        markers = subject.markers
        distance = KnownDistance(
            subject.first - 1, subject.second - 1, subject.length_mm, subject.sigma_mm
        )
        found = UnknownBody(markers, distance)
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
                    f'pose {row + 1} has {len(values)} readings of sensor "{name}"; the subject '
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
