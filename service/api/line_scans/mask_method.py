"""MaskMethod: the coded aperture whose shadow is sought in posted scans."""

from dataclasses import replace
from typing import Annotated, Final, Literal, Self

import numpy as np
from pydantic import Field, model_validator
from pydantic.dataclasses import dataclass as checked_dataclass

from compute.errors import InvalidParameter
from compute.optics.profiles.device_profile import DeviceProfile
from compute.optics.profiles.profile_optics import window_shadows
from compute.signal.centroid_settings import MAX_PIXELS
from compute.signal.coded_aperture.shadow_fit import ShadowSettings
from compute.signal.coded_aperture.shadow_template import ShadowTemplate
from hardware.field_bounds import FIRST_ERROR_ONLY
from service.api.devices.schema import PROFILE_PATTERN
from service.api.line_scans.chain_steps import STRICT
from service.pipeline.detection_stage import FindProfile
from service.problems.errors import UnknownDeviceProfile

MAX_CELLS: Final = 65536
MAX_SENSORS: Final = 64

Probability = Annotated[float, Field(ge=1e-15, le=0.5)]
Place = Annotated[int, Field(ge=-MAX_PIXELS, le=MAX_PIXELS)]


@checked_dataclass(frozen=True, config=STRICT)
class Template:
    """The shadow of a point whose reading is known: what a pixel gets anywhere in it."""

    cells: Annotated[
        list[Annotated[float, Field(ge=-1e12, le=1e12)]],
        Field(
            min_length=8,
            max_length=MAX_CELLS,
            description="Light of pixels centred at first_px + j / per_px, in any unit.",
        ),
        FIRST_ERROR_ONLY,
    ]
    reading_px: Annotated[
        float,
        Field(ge=-MAX_PIXELS, le=MAX_PIXELS, description="The reading of the shadow as it is."),
    ]
    first_px: Annotated[Place, Field(description="Place of the first cell [px].")] = 0
    per_px: Annotated[
        int, Field(ge=1, le=16, description="Cells in a pixel; 1 costs hundredths of a pixel.")
    ] = 1
    dark_beyond: Annotated[
        bool, Field(description="Nothing but even light beyond the cells; false: not known.")
    ] = True

    @property
    def shadow(self) -> ShadowTemplate:
        """Compute's form of it; raises InvalidParameter."""
        return ShadowTemplate(
            np.array(self.cells), self.per_px, self.first_px, self.reading_px, self.dark_beyond
        )


@checked_dataclass(frozen=True, config=STRICT)
class MaskMethod(ShadowSettings):
    """The shadow of one marker behind a coded window, at most one a line.

    By a weighted fit of the shadow, or by cross-correlation with it ([2.16] to [2.18]) refined by a
    parabola. What the shadow is like a `template` says, or a `profile_id` whose sensors have
    windows.
    """

    method: Literal["mask"] = "mask"
    estimator: Annotated[
        Literal["fit", "correlation"],
        Field(description="`correlation` gives no standard deviation."),
    ] = "fit"
    template: Annotated[Template | None, Field(description="Of all lines.")] = None
    profile_id: Annotated[
        str | None,
        Field(
            pattern=PROFILE_PATTERN,
            description="Of a device behind coded windows, such as `coda-mpx30`: its shadows of a "
            "marker in the middle of the volume.",
        ),
    ] = None
    sensors: Annotated[
        list[str] | None,
        Field(
            min_length=1,
            max_length=MAX_SENSORS,
            description="Of the profile: line l is of the (l modulo their number)-th; null: of all "
            "in turn, as in a frame.",
        ),
        FIRST_ERROR_ONLY,
    ] = None
    fit_scale: Annotated[
        bool,
        Field(description="Fit: for markers at other distances, whose shadows are larger."),
    ] = ShadowSettings.fit_scale
    false_alarms_per_line: Probability = ShadowSettings.false_alarms_per_line
    ambiguity_probability: Probability = ShadowSettings.ambiguity_probability
    misfit_probability: Probability = ShadowSettings.misfit_probability

    @model_validator(mode="after")
    def _one_source(self) -> Self:
        if (self.template is None) == (self.profile_id is None):
            both = "neither" if self.profile_id is None else "both"
            raise InvalidParameter(
                f"method has {both} of template and profile; give one of them, and not both"
            )
        if self.sensors is not None and self.profile_id is None:
            raise InvalidParameter(
                "method.sensors are those of a profile; give profile, or leave them out"
            )
        return self

    def templates(self, pixels: int, find_profile: FindProfile) -> tuple[ShadowTemplate, ...]:
        """Return the templates for scans of this length; scan l has the (l mod count)-th.

        Raises:
            InvalidParameter: a template or profile that is not for these lines, or no such profile.
        """
        if self.template is not None:
            return (self.template.shadow,)
        profile = self._found(find_profile)
        if profile.pixels.count != pixels:
            raise InvalidParameter(
                f"the lines have {pixels} pixels; those of profile {profile.name} have "
                f"{profile.pixels.count}",
                pixels=pixels,
            )
        names = [sensor.name for sensor in profile.sensors]
        for name in self.sensors or ():
            if name not in names:
                raise InvalidParameter(
                    f'profile {profile.name} has no sensor "{name}"; it has {", ".join(names)}',
                    sensor=name,
                )
        shadows = window_shadows(profile)
        if not shadows:
            raise InvalidParameter(
                f"profile {profile.name} has no coded windows; give another one, or a template",
                profile_id=profile.name,
            )
        return tuple(shadows[names.index(name)] for name in self.sensors or names)

    def of_line(self, line: int, find_profile: FindProfile) -> "MaskMethod":
        """Return the method for this line alone, which is of one sensor.

        Raises:
            InvalidParameter: there is no such profile.
        """
        if self.profile_id is None:
            return self
        names = self.sensors
        if names is None:
            names = [sensor.name for sensor in self._found(find_profile).sensors]
        return replace(self, sensors=[names[line % len(names)]])

    def _found(self, find_profile: FindProfile) -> DeviceProfile:
        assert self.profile_id is not None
        try:
            return find_profile(self.profile_id)
        except UnknownDeviceProfile as error:
            # A setting among others, and not what the request is about.
            raise InvalidParameter(
                f"method.profile: {error.detail}", profile_id=self.profile_id
            ) from error
