"""Device profiles and plans as clients receive them."""

from hashlib import sha256
from typing import Annotated, Any, TypeVar

from fastapi import Path, Query
from pydantic import Field, StringConstraints

from compute.optics.pixel_row import PixelRow
from compute.optics.profiles.device_profile import DeviceProfile, SensorProfile
from compute.optics.profiles.error_sources import ErrorSources
from compute.optics.profiles.profile_sections import (
    DetectorProfile,
    LedMarkers,
    PublishedFigure,
    Rates,
    RetroMarkers,
    Volume,
)
from service.api.base_models import RequestModel, ResponseModel
from service.api.devices.schema import PROFILE_PATTERN

MAX_GRID = 5

MAX_PROFILE_CHARACTERS = 65_536

ProfileText = Annotated[
    str,
    StringConstraints(min_length=1, max_length=MAX_PROFILE_CHARACTERS),
    Field(description="A profile's file (docs/how-to/profiles.md); `toml` of one is a beginning."),
]

Model = TypeVar("Model", bound=ResponseModel)

ProfilePath = Annotated[
    str,
    Path(
        pattern=PROFILE_PATTERN,
        description="The profile's name.",
        openapi_examples={"bar": {"summary": "the simulated bar with a real lens", "value": "bar"}},
    ),
]
GridQuery = Annotated[
    int,
    Query(
        ge=3,
        le=MAX_GRID,
        description="Points of the working volume along each axis; odd numbers hold its middle.",
        examples=[3],
    ),
]


class DeviceProfileSummary(ResponseModel):
    """A device in a few words."""

    id: str
    title: str
    year: int | None = Field(description="Of its publication, where known.")
    sensor_count: int
    pixel_count: int = Field(description="Of each sensor; of a plate with tracks, its tracks.")
    max_markers: int = Field(description="As many as the device drives.")


class DeviceProfileDocument(DeviceProfileSummary):
    """A device as published; lengths in mm, angles in rad, times in s."""

    sources: tuple[str, ...]
    sensors: tuple[SensorProfile, ...]
    pixels: PixelRow
    detector: DetectorProfile
    markers: LedMarkers | RetroMarkers
    rates: Rates
    volume: Volume
    published: tuple[PublishedFigure, ...]
    error_sources: ErrorSources = Field(
        description="What makes it inaccurate besides noise; null: a typical value is assumed, "
        "which the plan's budget names."
    )
    notes: tuple[str, ...]
    assumed: dict[str, str] = Field(
        description="Dotted paths of what the sources leave open, each with the reason."
    )
    toml: str = Field(
        description="The profile's file, its optics too: the start of one's own profile."
    )
    content_hash: str = Field(
        description="SHA-256 of this file; a nominal calibration names it in its `profile`."
    )


class NewDeviceProfile(RequestModel):
    """A profile to keep."""

    toml: ProfileText


class PlanRequest(RequestModel):
    """A profile to plan, which is not kept."""

    toml: ProfileText
    grid: Annotated[int, Field(ge=3, le=MAX_GRID)] = Field(
        default=3, description="Points of the working volume along each axis."
    )


def summary_of(profile: DeviceProfile) -> DeviceProfileSummary:
    """Return the summary of a profile."""
    return _document(DeviceProfileSummary, profile)


def document_of(profile: DeviceProfile, toml: str) -> DeviceProfileDocument:
    """Return the whole of a profile; ``toml`` is the text of its file."""
    return _document(
        DeviceProfileDocument,
        profile,
        notes=profile.notes + profile.limitations,
        assumed=dict(profile.assumed),
        toml=toml,
        content_hash=sha256(toml.encode()).hexdigest(),
    )


def _document(model: type[Model], profile: DeviceProfile, **members: Any) -> Model:
    """Return a model of the profile's fields of the same names, and of these members."""
    counts = {
        "sensor_count": len(profile.sensors),
        "pixel_count": profile.pixels.count,
        "max_markers": profile.markers.max_markers,
    }
    fields = {name: getattr(profile, name, None) for name in model.model_fields}
    fields["id"] = profile.name
    return model(**(fields | counts | members))
