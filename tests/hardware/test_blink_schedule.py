"""Blink schedules: light per code and exposure, also in the simulated device."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from compute.errors import InvalidParameter
from hardware.blink_schedule import BlinkSchedule
from hardware.simulated.driver import FrameRenderer
from hardware.simulated.scenes import StillPoints
from hardware.simulated.settings import SimulationSettings

THREE = StillPoints(((0.0, 0.0, 1500.0), (90.0, 60.0, 1450.0), (-130.0, -20.0, 1550.0)))
WORDS = ("00101", "01101", "11110")


@given(
    st.integers(2, 20).flatmap(
        lambda bits: st.lists(st.text("01", min_size=bits, max_size=bits), min_size=1, max_size=8)
    ),
    st.integers(0, 2**40),
    st.data(),
)
def test_light_is_the_words_bit(words: list[str], sequence: int, data: st.DataObject) -> None:
    phases = tuple(data.draw(st.integers(0, 19)) for _ in words)
    schedule = BlinkSchedule(tuple(words), 0.25, phases)
    light = schedule.light(np.array([sequence, sequence + 1]))
    for column, (word, phase) in enumerate(zip(words, phases, strict=True)):
        for row in range(2):
            bit = word[(sequence + row + phase) % len(word)]
            assert light[row, column] == (1.0 if bit == "1" else 0.25)


@pytest.mark.parametrize(
    ("words", "low", "phases", "said"),
    [
        (("01", "011"), 0.4, None, r"lengths \[2, 3\]"),
        (("01", "0a"), 0.4, None, "'a'"),
        (("0",), 0.4, None, "of length at least 2 and of length at most 20"),
        (("01",), 1.0, None, "low is 1"),
        (("01", "10"), 0.4, (1,), "phases are 1, words 2"),
        (tuple("01" for _ in range(65)), 0.4, None, "of length at most 64"),
    ],
)
def test_bad_schedules(
    words: tuple[str, ...], low: float, phases: tuple[int, ...] | None, said: str
) -> None:
    with pytest.raises(InvalidParameter, match=said):
        BlinkSchedule(words, low, phases)


def test_the_simulated_markers_blink() -> None:
    steady = SimulationSettings(scene=THREE, illumination="simultaneous")
    blinking = SimulationSettings(
        scene=THREE, illumination="simultaneous", blink=BlinkSchedule(WORDS, 0.25)
    )
    sequence = np.arange(7, 17)
    full = FrameRenderer(steady).signal_electrons(sequence)
    seen = FrameRenderer(blinking).signal_electrons(sequence)
    alone = [
        FrameRenderer(
            SimulationSettings(scene=StillPoints((point,)), illumination="simultaneous")
        ).signal_electrons(sequence[:1])[0]
        for point in THREE.points_mm
    ]
    np.testing.assert_allclose(full[0], sum(alone), atol=1e-6)
    for row, number in enumerate(sequence):
        light = [1.0 if word[number % 5] == "1" else 0.25 for word in WORDS]
        expected = sum(share * one for share, one in zip(light, alone, strict=True))
        np.testing.assert_allclose(seen[row], expected, atol=1e-6)


def test_blinking_wants_simultaneous_markers_and_a_word_of_each() -> None:
    with pytest.raises(InvalidParameter, match="strobed"):
        SimulationSettings(scene=THREE, blink=BlinkSchedule(WORDS))
    with pytest.raises(InvalidParameter, match="2 words; the scene has 3 markers"):
        SimulationSettings(scene=THREE, illumination="simultaneous", blink=BlinkSchedule(WORDS[:2]))
