"""How a device's markers blink, as clients give it."""

from typing import Annotated, Self

from pydantic import Field, model_validator

from compute.tracking.blinking import BlinkModel
from compute.tracking.blinking_codes import LONGEST, BlinkCodes
from service.schema import Given

MOST_WORDS = 64
LEAST_BITS = 5
LEAST_DISTANCE = 3
"""So that one wrong scan of a word is corrected, and two do not make it another."""


class Blinking(Given):
    """The codes that markers show, one bit an exposure, again and again."""

    words: Annotated[
        list[Annotated[str, Field(min_length=LEAST_BITS, max_length=LONGEST, pattern="^[01]*$")]],
        Field(min_length=1, max_length=MOST_WORDS),
    ] = Field(
        description="Of marker 0, 1, ..., all equally long: 1 for full light, 0 for little. Any "
        f"two must differ in {LEAST_DISTANCE} bits at least, in whatever phase; "
        "`lumiline blink-codes` makes such words.",
        examples=[["000000010111", "000000111011"]],
    )
    low: Annotated[float, Field(ge=0.05, le=0.8)] = Field(
        default=0.4,
        description="Light of a 0, relative to a 1. Markers must not go dark: what is not "
        "seen in half of the exposures is not tracked well.",
    )
    missed: Annotated[float, Field(ge=1e-4, le=0.5)] = Field(
        default=BlinkModel().missed, description="Chance that a sensor misses a marker's peak."
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
        codes = BlinkCodes(tuple(self.words), LEAST_DISTANCE)
        return codes, BlinkModel(missed=self.missed, low=self.low)
