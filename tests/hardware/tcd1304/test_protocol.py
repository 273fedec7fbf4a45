"""Request: encoding, registers and timing."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from compute.errors import InvalidParameter
from hardware.tcd1304.protocol import (
    CLOCK_HZ,
    MIN_ICG_CLOCKS,
    Request,
    request_for,
)
from tests.hardware.tcd1304.simulated_board import REQUEST_BYTES, decode_request


def test_a_request_byte_by_byte() -> None:
    """20000 = 0x4E20 clocks of SH, 500000 = 0x7A120 of ICG, one line, the mean of 7."""
    request = Request(20_000, 500_000, averages=7)
    assert request.encode() == bytes.fromhex("4552 00004e20 0007a120 00 07")
    continuous = Request(20_000, 500_000, averages=7, continuous=True)
    assert continuous.encode() == bytes.fromhex("4552 00004e20 0007a120 01 07")


@given(
    st.integers(20, 2**32 - 1),
    st.integers(1, 2**20),
    st.integers(1, 255),
    st.booleans(),
)
def test_a_request_is_read_as_it_was_written(
    sh_clocks: int, pulses: int, averages: int, continuous: bool
) -> None:
    icg_clocks = sh_clocks * pulses
    if not MIN_ICG_CLOCKS <= icg_clocks < 2**32:
        with pytest.raises(InvalidParameter, match="ICG period is"):
            Request(sh_clocks, icg_clocks, averages, continuous)
        return
    request = Request(sh_clocks, icg_clocks, averages, continuous)
    assert len(request.encode()) == REQUEST_BYTES
    assert decode_request(request.encode()) == request


@pytest.mark.parametrize(
    ("sh_clocks", "icg_clocks", "averages", "clock_hz", "message"),
    [
        (19, 19_000, 1, CLOCK_HZ, "SH period is 19; it must lie between 20 and 4294967295"),
        (20, 20_000, 1, 4_000_000, "SH period is 20; it must lie between 40"),
        (20, 14_760, 1, CLOCK_HZ, "ICG period is 14760; it must lie between 14776"),
        (20, 2**32 + 4, 1, CLOCK_HZ, "ICG period is 4294967300; it must lie between 14776"),
        (20, 14_790, 1, CLOCK_HZ, "no multiple of the SH period 20; 14800 is one"),
        (20, 14_780, 0, CLOCK_HZ, "averages is 0; it must lie between 1 and 255"),
        (20, 14_780, 256, CLOCK_HZ, "averages is 256"),
    ],
)
def test_what_the_board_would_not_do_is_refused(
    sh_clocks: int, icg_clocks: int, averages: int, clock_hz: int, message: str
) -> None:
    with pytest.raises(InvalidParameter, match=message):
        Request(sh_clocks, icg_clocks, averages, clock_hz=clock_hz)


@pytest.mark.parametrize("data", [b"", b"ER", b"RE" + bytes(10), Request(20, 20_000).encode()[:-1]])
def test_other_bytes_are_no_request(data: bytes) -> None:
    with pytest.raises(InvalidParameter, match="a request has 12 bytes and begins with b'ER'"):
        decode_request(data)


@given(st.floats(10.0, 6e7), st.sampled_from([800_000, 2_000_000, 4_000_000]))
def test_an_exposure_is_met_to_half_a_clock_and_read_out_as_soon_as_possible(
    exposure_us: float, clock_hz: int
) -> None:
    request = request_for(exposure_us, clock_hz=clock_hz)
    assert abs(request.exposure_ns - exposure_us * 1e3) <= 0.5e9 / clock_hz + 1.0
    assert request.icg_clocks - request.sh_clocks < MIN_ICG_CLOCKS <= request.icg_clocks


def test_the_times_of_one_line_and_of_a_mean() -> None:
    """SH 10 ms, ICG 20 ms; reading 3694 elements of 4 clocks takes 7.388 ms."""
    one = Request(20_000, 40_000)
    assert (one.exposure_ns, one.end_to_response_ns) == (10_000_000, 7_388_000)
    assert one.centre_to_response_ns == 5_000_000 + 7_388_000
    mean = Request(20_000, 40_000, averages=5)
    assert mean.centre_to_response_ns == (10_000_000 + 4 * 20_000_000) // 2 + 7_388_000
    assert mean.max_wait_ns == 30_000_000 + 9 * 20_000_000 + 7_388_000
