"""Generated examples: the same in each run by default, new ones where asked."""

import os
import subprocess
import sys
from pathlib import Path

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
print(drawn, settings.default.database, settings.default.print_blob, settings.default.max_examples)
"""


def draw(profile: str | None) -> str:
    """What a run draws and how it is set."""
    environment = {
        key: value
        for key, value in os.environ.items()
        if key != "LUMILINE_TEST_EXAMPLES" and not key.startswith(("PYTEST", "HYPOTHESIS"))
    }
    if profile is not None:
        environment["LUMILINE_TEST_EXAMPLES"] = profile
    environment["PYTHONPATH"] = str(ROOT)
    return subprocess.run(
        [sys.executable, "-c", DRAW],
        cwd=ROOT,
        env=environment,
        check=True,
        capture_output=True,
        text=True,
    ).stdout


def test_examples_by_default_are_few_and_the_same_in_each_run() -> None:
    drawn = draw(None)
    assert drawn == draw("deterministic")
    assert "None" in drawn
    assert drawn.endswith(" 30\n")


def test_random_examples_differ_and_print_what_reproduces_them() -> None:
    first, second = draw("random"), draw("random")
    assert first != second
    assert first.endswith("None True 100\n")
