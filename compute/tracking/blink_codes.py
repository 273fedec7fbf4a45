"""BlinkCodes: on/off code words with a minimum distance in every phase."""

from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray

from compute.errors import InvalidParameter

Words = NDArray[np.uint32]

MAX_CODE_LENGTH: Final = 20
"""Bits of a word at most: 52,488 words that are no rotations of each other."""


@dataclass(frozen=True)
class BlinkCodes:
    """Code words that markers blink periodically over successive scans.

    The constructor compares every word with every rotation of every word and refuses a set that
    has not got its distance: what it holds is proved.

    Args:
        words: of the markers, each a text of "1" (on) and "0" (off), all equally long.
        distance: bits in which any two differ, at least: with up to ``(distance - 1) // 2`` wrong
            bits a word is still nearest to itself, and with up to ``distance - 1`` it is not
            another.
        cyclic: whether that holds for all rotations, a word's own among them, so that the phase
            need not be known; otherwise for words that begin at the same scan.

    Raises:
        InvalidParameter: words of other characters or lengths, or nearer to each other than that.
    """

    words: tuple[str, ...]
    distance: int
    cyclic: bool = True

    def __post_init__(self) -> None:
        lengths = {len(word) for word in self.words}
        if len(lengths) != 1 or not 2 <= max(lengths) <= MAX_CODE_LENGTH:
            raise InvalidParameter(
                f"words have the lengths {sorted(lengths)}; they must all have one, of 2 to "
                f"{MAX_CODE_LENGTH} bits"
            )
        if any(set(word) - {"0", "1"} for word in self.words):
            raise InvalidParameter("a word has other characters than 0 and 1")
        if self.distance < 1 or self.minimum_distance < self.distance:
            raise InvalidParameter(
                f"the words' least distance is {self.minimum_distance}; it must be at least "
                f"{self.distance}, and that at least 1",
                distance=self.distance,
            )

    def __len__(self) -> int:
        """Return the number of markers."""
        return len(self.words)

    @property
    def length(self) -> int:
        """Number of bits of a word."""
        return len(self.words[0])

    @property
    def corrected(self) -> int:
        """Number of wrong bits that can be corrected."""
        return (self.distance - 1) // 2

    @cached_property
    def minimum_distance(self) -> int:
        """Return the minimum Hamming distance of any two words, in any phase if they are cyclic."""
        values = np.array([int(word, 2) for word in self.words], dtype=np.uint32)
        least = self.length
        for shift in range(self.length if self.cyclic else 1):
            apart = np.bitwise_count(values[:, None] ^ _rotate(values, shift, self.length))
            if shift == 0:
                apart = apart[~np.eye(len(values), dtype=np.bool_)]
            least = min(least, int(apart.min(initial=self.length)))
        return least

    @cached_property
    def bits(self) -> NDArray[np.bool_]:
        """Whether each marker is on in each scan of a word, shape (M, length)."""
        return np.array([[bit == "1" for bit in word] for word in self.words])


def blink_codes(
    markers: int, length: int, distance: int, *, cyclic: bool = True, min_on: int | None = None
) -> BlinkCodes:
    """Return words for a number of markers, chosen greedily by their minimum distance.

    Lexicographic codes: all words in order, of which rotations of one another count once if the
    codes are cyclic. They are not the largest sets that exist.

    Args:
        markers: how many, at least 1.
        length: scans of a word, 2 to LONGEST.
        distance: see ``BlinkCodes``; 3 corrects a wrong bit, 5 two.
        cyclic: see ``BlinkCodes``.
        min_on: scans of a word in which a marker is on, at least; None: a third of them.

    Raises:
        InvalidParameter: there are too few such words, with how many were found, or a value is
            out of its range.
    """
    if not 2 <= length <= MAX_CODE_LENGTH:
        raise InvalidParameter(
            f"length is {length}; it must be 2 to {MAX_CODE_LENGTH}", length=length
        )
    if markers < 1:
        raise InvalidParameter(f"markers is {markers}; it must be at least 1", markers=markers)
    if not 1 <= distance <= length:
        raise InvalidParameter(
            f"distance is {distance}; it must be 1 to the length {length}", distance=distance
        )
    on = (length + 2) // 3 if min_on is None else min_on
    words = np.arange(1, 2**length, dtype=np.uint32)
    words = words[np.bitwise_count(words) >= on]
    shifts = range(1, length) if cyclic else range(0)
    for shift in shifts:
        turned = _rotate(words, shift, length)
        # The least of its rotations stands for a word; it must keep away from the others itself.
        words = words[(words <= turned) & (np.bitwise_count(words ^ turned) >= distance)]
    selected: list[int] = []
    while len(words) and len(selected) < markers:
        word = words[:1]
        selected.append(int(word[0]))
        for shift in (0, *shifts):
            words = words[np.bitwise_count(words ^ _rotate(word, shift, length)) >= distance]
    if len(selected) < markers:
        raise InvalidParameter(
            f"{len(selected)} words of {length} bits were found at a distance of {distance} with "
            f"{on} bits on; {markers} markers need longer words or a smaller distance",
            found=len(selected),
        )
    return BlinkCodes(tuple(f"{word:0{length}b}" for word in selected), distance, cyclic)


def _rotate(words: Words, shift: int, length: int) -> Words:
    mask = np.uint32(2**length - 1)
    rotated_left = (words << np.uint32(shift)) & mask
    rotated: Words = rotated_left | (words >> np.uint32(length - shift)) if shift else words
    return rotated
