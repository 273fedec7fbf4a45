"""Self-calibration requests: wands, rigid bodies and frames at unknown positions."""

from collections.abc import Sequence
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from compute.calibration.self_calibration.targets import Recording
from compute.errors import InvalidParameter, ReadingOutsideSensor, UnknownSensor
from hardware.driver import SensorDescription
from hardware.field_bounds import FIRST_ERROR_ONLY
from service.api.base_models import Note, RequestModel, Slug
from service.api.calibrations.schema import GivenDistortion, SensorName
from service.api.wave_captures.schema import (
    MAX_MARKERS,
    MAX_POSES,
    BodyTarget,
    MovedTarget,
    UnknownTarget,
    WandTarget,
    calibration_target,
)
from service.api.wave_captures.stored_wave import StoredWave

MarkerReadings = Annotated[
    dict[
        SensorName, Annotated[list[float | None], Field(max_length=MAX_MARKERS), FIRST_ERROR_ONLY]
    ],
    Field(
        max_length=64,
        description="By sensor: the peak of each marker [px], null where it was not seen. Leave "
        "out sensors that saw none.",
    ),
]


class NewRecording(RequestModel):
    """One target, held or waved, and what the sensors read of it."""

    target: MovedTarget
    poses: Annotated[list[MarkerReadings], Field(max_length=MAX_POSES), FIRST_ERROR_ONLY]
    sigma_px: (
        Annotated[float, Field(ge=1e-6, le=1e4)]
        | Annotated[list[MarkerReadings], Field(max_length=MAX_POSES), FIRST_ERROR_ONLY]
        | None
    ) = Field(
        default=None,
        description="Standard deviation of the readings, or of each, in the form of `poses`; null: "
        "from the residuals.",
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
    recordings: (
        Annotated[list[NewRecording], Field(min_length=1, max_length=16), FIRST_ERROR_ONLY] | None
    ) = Field(default=None, description="Give these, or `wave_capture_id`.")
    wave_capture_id: Slug | None = Field(
        default=None, description="A capture of a waved wand or body, in place of recordings."
    )
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
    target = calibration_target(given.target)
    readings = _array(given.poses, len(target), sensors, "pose")
    for column, sensor in enumerate(sensors):
        read = readings[..., column]
        last = sensor.pixels - 0.5
        outside = np.argwhere((read < -0.5) | (read > last))
        if len(outside):
            row, marker = outside[0].tolist()
            raise ReadingOutsideSensor(
                f"the reading {read[row, marker]:g} px of pose {row + 1} lies outside sensor "
                f'"{sensor.name}", whose pixels reach from -0.5 to {last:g} px',
                sensor=sensor.name,
            )
    sigma = None
    if isinstance(given.sigma_px, list):
        if len(given.sigma_px) != len(given.poses):
            raise InvalidParameter(
                f"sigma_px has {len(given.sigma_px)} poses, the recording {len(given.poses)}; give "
                "the standard deviations of each"
            )
        sigma = _array(given.sigma_px, len(target), sensors, "sigma_px: pose")
    elif given.sigma_px is not None:
        sigma = np.full(readings.shape, given.sigma_px)
    return Recording(target, readings, sigma)


def _array(
    poses: Sequence[MarkerReadings],
    markers: int,
    sensors: Sequence[SensorDescription],
    which: str,
) -> NDArray[np.float64]:
    """Return values by pose, marker and sensor; NaN where there is none."""
    columns = {sensor.name: index for index, sensor in enumerate(sensors)}
    values = np.full((len(poses), markers, len(sensors)), np.nan)
    for row, pose in enumerate(poses):
        for name, given in pose.items():
            if name not in columns:
                raise UnknownSensor(
                    f'{which} {row + 1} has readings of sensor "{name}", which the device does not '
                    f"have; its sensors are {', '.join(columns)}",
                    sensor=name,
                )
            if len(given) != markers:
                raise InvalidParameter(
                    f'{which} {row + 1} has {len(given)} readings of sensor "{name}"; the target '
                    f"has {markers} markers: give null for one that was not seen",
                    sensor=name,
                )
            values[row, :, columns[name]] = [np.nan if one is None else one for one in given]
    return values


def recording_of_wave(
    target: WandTarget | BodyTarget | UnknownTarget,
    taken: StoredWave,
    sensors: Sequence[SensorDescription],
) -> NewRecording:
    """Return the poses of a wave capture as the recording that a client would have posted."""
    seen = np.isfinite(taken.readings_px)
    known = bool((taken.sigma_px[seen] > 0.0).all())
    return NewRecording(
        target=target,
        poses=_documents(taken.readings_px, sensors),
        sigma_px=_documents(np.where(seen, taken.sigma_px, np.nan), sensors) if known else None,
    )


def _documents(
    values: NDArray[np.float64], sensors: Sequence[SensorDescription]
) -> list[MarkerReadings]:
    """Return values (B, K, S) by pose and sensor; None in place of NaN."""
    return [
        {
            sensor.name: [None if np.isnan(one) else one for one in pose[:, column].tolist()]
            for column, sensor in enumerate(sensors)
            if np.isfinite(pose[:, column]).any()
        }
        for pose in values
    ]
