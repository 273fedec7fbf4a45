"""Settings of the simulated device."""

from dataclasses import dataclass, field
from typing import Annotated, Literal

from pydantic import Field

from compute.errors import InvalidParameter
from hardware.blink_schedule import BlinkSchedule
from hardware.driver import PeakMethod
from hardware.field_bounds import CheckedSettings
from hardware.simulated.frame_batch import Timing
from hardware.simulated.pixel_defects import PixelDefects
from hardware.simulated.placement import BarPlacement
from hardware.simulated.scenes import RotatingBar, Scene
from hardware.strobe_schedule import StrobeSchedule


@dataclass(frozen=True)
class SimulationSettings(CheckedSettings):
    """What the simulated device shows, and how its sensors see it.

    Args:
        scene: the markers and their motion.
        frame_rate_hz: exposures per second.
        illumination: "strobed" lights marker n modulo M in exposure n, "simultaneous" all.
        strobe: another order of the strobed markers, one in each slot; None: each in turn.
        blink: codes by which simultaneous markers are dimmed, one of each marker; None: steady.
        spot_sigma_px: standard deviation of a light line's shape [px].
        signal_electrons: mean electrons of a line from a marker in the middle of the working
            volume, 1500 mm in front of the bar.
        distance_falloff: whether light falls with the square of the distance.
        ambient_electrons: mean electrons of ambient light in each pixel and exposure.
        read_noise_electrons: standard deviation of the read noise.
        full_well_electrons: electrons that a pixel holds at most.
        electrons_per_count: gain of the conversion.
        offset_counts: the count without light.
        bits: resolution of the conversion.
        pixels: differences of the pixels, and bad ones; None: all are alike.
        seed: seed of the noise; the same settings and seed give the same frames, bit by bit.
        peaks: "fit" measures the lines' peaks by a fit of their shape, "centroid" by threshold and
            centre of gravity.
        placement: where the bar stands in a hall; None: the scene is in the bar's coordinates, and
            begins when it is started.
        duration_s: length of the scene [s], at least one exposure; None: endless.
        realtime: True: a frame is delivered when it is exposed; False: as soon as it is asked
            for. The lines are the same.

    Raises:
        InvalidParameter: a value is outside of its bounds.
    """

    scene: Scene = field(default_factory=RotatingBar)
    frame_rate_hz: Annotated[float, Field(ge=0.01, le=10_000.0)] = 1000.0
    illumination: Literal["strobed", "simultaneous"] = "strobed"
    strobe: StrobeSchedule | None = None
    blink: BlinkSchedule | None = None
    spot_sigma_px: Annotated[float, Field(ge=0.1, le=100.0)] = 2.0
    signal_electrons: Annotated[float, Field(ge=0.0, le=1e8)] = 100_000.0
    distance_falloff: bool = True
    ambient_electrons: Annotated[float, Field(ge=0.0, le=20_000.0)] = 400.0
    read_noise_electrons: Annotated[float, Field(ge=0.0, le=500.0)] = 30.0
    full_well_electrons: Annotated[float, Field(ge=100.0, le=1e7)] = 60_000.0
    electrons_per_count: Annotated[float, Field(ge=0.5, le=1e4)] = 12.0
    offset_counts: Annotated[float, Field(ge=0.0, le=200.0)] = 64.0
    bits: Annotated[int, Field(ge=8, le=16)] = 12
    pixels: PixelDefects | None = None
    seed: Annotated[int, Field(ge=0, le=2**32 - 1)] = 1
    peaks: PeakMethod = "fit"
    placement: BarPlacement | None = None
    duration_s: Annotated[float, Field(gt=0.0, le=1e7)] | None = None
    realtime: bool = True

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.strobe is not None:
            self._check_strobe(self.strobe)
        if self.blink is not None:
            self._check_blink(self.blink)

    def _check_strobe(self, strobe: StrobeSchedule) -> None:
        if self.illumination != "strobed":
            raise InvalidParameter(
                'strobe is given, and illumination is "simultaneous"; leave one of them out'
            )
        if None in strobe.slots or strobe.markers > self.scene.markers:
            raise InvalidParameter(
                f"strobe has the slots {list(strobe.slots)}; each must light one of the scene's "
                f"markers, 0 to {self.scene.markers - 1}",
                slots=strobe.slots,
            )

    def _check_blink(self, blink: BlinkSchedule) -> None:
        if self.illumination != "simultaneous":
            raise InvalidParameter(
                'blink is given, and illumination is "strobed"; markers that are lit one at a time '
                'do not blink: leave blink out, or make it "simultaneous"'
            )
        if len(blink.words) != self.scene.markers:
            raise InvalidParameter(
                f"blink has {len(blink.words)} words; the scene has {self.scene.markers} markers",
                words=len(blink.words),
            )

    @property
    def timing(self) -> Timing:
        """Timing of the exposures, and the marker that each lights."""
        slots = self.strobe.slots if self.strobe else ()
        return Timing(
            self.frame_rate_hz,
            self.strobed_markers,
            self.duration_s,
            self.realtime,
            tuple(slot for slot in slots if slot is not None),
        )

    @property
    def strobed_markers(self) -> int:
        """Number of strobed markers, 0 when they are lit together."""
        return self.scene.markers if self.illumination == "strobed" else 0
