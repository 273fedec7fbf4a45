"""How a device's markers blink, as clients give it."""

from typing import Annotated, Self

from pydantic import Field, model_validator

from compute.tracking.blink_codes import MAX_CODE_LENGTH, BlinkCodes
from compute.tracking.blink_decoding import BlinkModel
from service.api.base_models import RequestModel

MAX_CODE_WORDS = 64
MIN_BITS = 5
MIN_DISTANCE = 3
"""So that one wrong scan of a word is corrected, and two do not make it another."""


class Blinking(RequestModel):
    """The codes that markers show, one bit an exposure, again and again."""

    words: Annotated[
        list[
            Annotated[
                str, Field(min_length=MIN_BITS, max_length=MAX_CODE_LENGTH, pattern="^[01]*$")
            ]
        ],
        Field(min_length=1, max_length=MAX_CODE_WORDS),
    ] = Field(
        description="Of marker 0, 1, ..., all equally long: 1 for full light, 0 for little. Any "
        f"two must differ in {MIN_DISTANCE} bits at least, in whatever phase; "
        "`lumiline blink-codes` makes such words.",
        examples=[["000000010111", "000000111011"]],
    )
    off_level: Annotated[float, Field(ge=0.05, le=0.8)] = Field(
        default=0.4,
        description="Light of a 0, relative to a 1. Markers must not go dark: what is not "
        "seen in half of the exposures is not tracked well.",
    )
    miss_probability: Annotated[float, Field(ge=1e-4, le=0.5)] = Field(
        default=BlinkModel().miss_probability,
        description="Chance that a sensor misses a marker's peak.",
    )

    @model_validator(mode="after")
    def _check(self) -> Self:
        self.codes()
        return self

    def codes(self) -> tuple[BlinkCodes, BlinkModel]:
        """Return the codes, and how the markers show them.

        Raises:
            InvalidParameter: words of several lengths, or too near to each other.
        """
        codes = BlinkCodes(tuple(self.words), MIN_DISTANCE)
        return codes, BlinkModel(miss_probability=self.miss_probability, off_level=self.off_level)
