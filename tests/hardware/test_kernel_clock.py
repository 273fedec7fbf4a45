"""Uncertainty of the host's clock: what the kernel states, and hosts that do not know."""

import pytest

from hardware.kernel_clock import UNSYNCHRONISED, Timex, kernel_clock_sigma_ns


def told(state: int, **members: int):
    """A kernel that states this."""

    def ask(timex: Timex) -> int:
        assert timex.modes == 0, "it must not be changed"
        for name, value in members.items():
            setattr(timex, name, value)
        return state

    return ask


def test_it_is_what_is_estimated() -> None:
    assert kernel_clock_sigma_ns(told(0, estimated_error_us=30, max_error_us=900)) == 30e3


def test_without_an_estimate_it_is_that_of_the_bound() -> None:
    found = kernel_clock_sigma_ns(told(0, max_error_us=900))
    assert found == pytest.approx(900e3 / 3**0.5)


@pytest.mark.parametrize(("state", "status"), [(-1, 0), (5, UNSYNCHRONISED)])
def test_a_clock_that_nothing_synchronises_is_not_known(state: int, status: int) -> None:
    assert kernel_clock_sigma_ns(told(state, status=status, estimated_error_us=5)) is None


def test_this_hosts_kernel_answers_or_does_not() -> None:
    found = kernel_clock_sigma_ns()
    assert found is None or found >= 0.0
