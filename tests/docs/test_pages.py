"""Every page is in the site, and names only files and modules that exist."""

import importlib
import importlib.util
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAGES = sorted(
    path
    for path in [*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")]
    if "generated" not in path.parts
)
PACKAGES = "compute|hardware|service|lumiline|migrations|validation|benchmarks"
# They describe the code as it was when the decision was made.
CURRENT = [path for path in PAGES if "decisions" not in path.parts and path.stem != "CHANGELOG"]


def name(path: Path) -> str:
    return str(path.relative_to(ROOT))


@pytest.mark.parametrize("path", CURRENT, ids=name)
def test_page_names_files_that_exist(path: Path) -> None:
    named = re.findall(
        rf"`((?:{PACKAGES}|tests|docker|docs|deploy)/[\w./-]*[\w/])`", path.read_text()
    )
    assert [one for one in named if not (ROOT / one).exists()] == []


@pytest.mark.parametrize("path", CURRENT, ids=name)
def test_page_names_modules_that_exist(path: Path) -> None:
    named = set(re.findall(rf"`((?:{PACKAGES})(?:\.\w+)+)[`(]", path.read_text()))
    named -= {"lumiline.toml", "lumiline.service", "lumiline.lock"}
    # Subjects of the bus.
    named = {one for one in named if not one.startswith("lumiline.v1.")}
    assert [one for one in sorted(named) if not exists(one)] == []


def exists(dotted: str) -> bool:
    """Whether it is a module, or an attribute path in one."""
    words = dotted.split(".")
    for length in range(len(words), 0, -1):
        path = ROOT.joinpath(*words[:length])
        if (path / "__init__.py").is_file() or path.with_suffix(".py").is_file():
            if length == len(words):
                return True
            module = importlib.import_module(".".join(words[:length]))
            value: object = module
            for word in words[length:]:
                fields = getattr(value, "__dataclass_fields__", {})
                if not hasattr(value, word) and word not in fields:
                    return False
                value = getattr(value, word, None)
            return True
    return False


@pytest.mark.slow
def test_generated_reference_has_every_operation_and_command() -> None:
    if importlib.util.find_spec("sphinx") is None:
        pytest.skip("needs the extra `docs`")
    import sys

    sys.path.insert(0, str(ROOT / "docs"))
    try:
        from generators import PAGES as GENERATED
    finally:
        sys.path.pop(0)
    rest = GENERATED["rest.md"]()
    assert rest.count("\n**") > 100
    assert "(create-device)=" in rest
    assert "## lumiline calibrate" in GENERATED["command-line.md"]()
    assert "### Hello" in GENERATED["stream-messages.md"]()
    assert "`LUMILINE_PORT`" in GENERATED["settings.md"]()
