"""Generated examples: the same in each run by default, new ones where asked."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]

DRAW = """
import tests.conftest
from hypothesis import given, settings, strategies as st
drawn = []

@settings(max_examples=10)
@given(st.floats(0.0, 1.0))
def draw(value):
    drawn.append(value)

draw()
print(drawn, settings.default.database, settings.default.print_blob)
"""


def draws(profile: str | None) -> list[str]:
    """What two runs draw and how they are set."""
    environment = {
        key: value
        for key, value in os.environ.items()
        if key != "LUMILINE_TEST_EXAMPLES" and not key.startswith(("PYTEST", "HYPOTHESIS"))
    }
    if profile is not None:
        environment["LUMILINE_TEST_EXAMPLES"] = profile
    environment["PYTHONPATH"] = str(ROOT)
    return [
        subprocess.run(
            [sys.executable, "-c", DRAW],
            cwd=ROOT,
            env=environment,
            check=True,
            capture_output=True,
            text=True,
        ).stdout
        for _ in range(2)
    ]


@pytest.mark.parametrize("profile", [None, "deterministic"])
def test_examples_by_default_are_the_same_in_each_run(profile: str | None) -> None:
    first, second = draws(profile)
    assert first == second
    assert "None" in first


def test_random_examples_differ_and_print_what_reproduces_them() -> None:
    first, second = draws("random")
    assert first != second
    assert first.endswith("None True\n")
