"""Exports as clients ask for and receive them."""

from typing import Annotated, Final, Literal, get_args

from pydantic import Field, StringConstraints

from hardware.field_bounds import FIRST_ERROR_ONLY
from service.api.base_models import Moment, RequestModel, ResponseModel, Slug
from service.api.devices.schema import RECORDING_PATTERN

Format = Literal["c3d", "trc", "csv", "parquet", "igs.mha"]
FORMATS: Final[tuple[Format, ...]] = get_args(Format)


class NewExportRun(RequestModel):
    """A recording of which points, tracks and tool poses are to be written to a file."""

    id: Slug | None = Field(default=None, description="The run's; left out: the server's choice.")
    device_id: Slug = Field(
        description="The device whose tools are followed, as its `tracking` says; now, as neither "
        "is in the recording."
    )
    recording_id: Annotated[str, StringConstraints(max_length=200, pattern=RECORDING_PATTERN)] = (
        Field(description="File name below the folder `recordings`.")
    )
    format: Format
    result_id: Slug | None = Field(
        default=None, description="Of the file to be made; left out: the run's id."
    )
    tool_ids: Annotated[list[Slug], Field(max_length=64), FIRST_ERROR_ONLY] | None = Field(
        default=None, description="Those of the device that are wanted; null: all."
    )
    calibration_id: Slug | None = Field(
        default=None,
        description="Instead of the calibration that was active at each frame; null: that.",
    )
    table_id: Slug | None = Field(
        default=None, description="A correction table of that `calibration_id`; null: none."
    )
    predicted: bool = Field(
        default=False, description="C3D and TRC: fill gaps with what the tracker predicts."
    )
    points: bool = Field(
        default=False, description="C3D and TRC: points of strobed markers in the tracks' place."
    )


class ExportFile(ResponseModel):
    """A file that an export run has made."""

    id: str
    format: Format
    file_name: str = Field(description="What it is called when it is downloaded.")
    media_type: str
    size_bytes: int
    created_at: Moment
    gateway: str | None = Field(
        default=None,
        description="The gateway that has the file in its data directory, and alone gives it; "
        "null: the one that answers.",
    )


class Export(ExportFile):
    """A file that an export run has made, and of what."""

    run_id: str | None = Field(description="The run that made it; null: that was deleted.")
    device_id: str | None = Field(description="As the run says.")
    recording_id: str | None = Field(description="As the run says.")
