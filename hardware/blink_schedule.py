"""The blink schedule: simultaneous markers dimmed by binary codes, one bit per exposure.

Thesis, section 4.6: a target's pulses "could also be modulated for easier identification".
"""

from dataclasses import dataclass
from typing import Annotated, Final

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from compute.errors import InvalidParameter
from hardware.field_bounds import FIRST_ERROR_ONLY, CheckedSettings

MAX_CODE_BITS: Final = 20
"""Maximum length of a code word [bits], as in ``compute.tracking.blink_codes``."""
MAX_CODE_WORDS: Final = 64


@dataclass(frozen=True)
class BlinkSchedule(CheckedSettings):
    """Cyclic code words of the markers, one bit per exposure, each with its own phase.

    Args:
        words: of marker 0, 1, ..., all equally long: "1" full light, "0" little.
        low: light of a "0", relative to a "1".
        phases: bit of each word in exposure 0; None: the first bit of all.

    Raises:
        InvalidParameter: words of several lengths or of other characters, other numbers of phases.
    """

    words: Annotated[
        tuple[Annotated[str, Field(min_length=2, max_length=MAX_CODE_BITS)], ...],
        Field(min_length=1, max_length=MAX_CODE_WORDS),
        FIRST_ERROR_ONLY,
    ]
    low: Annotated[float, Field(ge=0.0, lt=1.0)] = 0.4
    phases: (
        Annotated[tuple[Annotated[int, Field(ge=0, lt=MAX_CODE_BITS)], ...], FIRST_ERROR_ONLY]
        | None
    ) = None

    def __post_init__(self) -> None:
        super().__post_init__()
        lengths = {len(word) for word in self.words}
        if len(lengths) != 1:
            raise InvalidParameter(
                f"words have the lengths {sorted(lengths)}; they must all have one, of 2 to "
                f"{MAX_CODE_BITS} bits"
            )
        other = sorted(set("".join(self.words)) - {"0", "1"})
        if other:
            raise InvalidParameter(f"a word has {other[0]!r}; words are of 0 and 1")
        if self.phases is not None and len(self.phases) != len(self.words):
            raise InvalidParameter(
                f"phases are {len(self.phases)}, words {len(self.words)}; give one of each word"
            )

    def light(self, sequence: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the relative light of M markers in F exposures, shape (F, M); 1 is full light.

        Args:
            sequence: the exposures' numbers, shape (F,).
        """
        bits = np.array([[bit == "1" for bit in word] for word in self.words])
        phases = np.array(self.phases or (0,) * len(self.words))
        at = (sequence[:, None] + phases) % bits.shape[1]
        light: NDArray[np.float64] = np.where(bits[np.arange(len(bits)), at], 1.0, self.low)
        return light
