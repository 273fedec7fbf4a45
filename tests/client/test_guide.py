"""The programs of the guide work as they stand."""

import re
from pathlib import Path

import pytest

GUIDE = Path(__file__).parents[2] / "docs" / "how-to" / "client.md"
PROGRAMS = re.findall(r"```python\n(.*?)```", GUIDE.read_text(), re.DOTALL)


@pytest.mark.parametrize("program", PROGRAMS)
def test_a_program_of_the_guide(
    program: str, server: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert "http://127.0.0.1:8000" in program
    exec(compile(program.replace("http://127.0.0.1:8000", server), GUIDE.name, "exec"), {})
    assert capsys.readouterr().out


def test_methods_that_the_guide_names_exist() -> None:
    from lumiline.client import Client

    called = set(re.findall(r"(?:`|client\.)(\w+)\(", GUIDE.read_text())) - {"Client"}
    assert len(called) > 12
    assert called <= set(dir(Client))
