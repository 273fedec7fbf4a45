"""Names of transforms: what they are, how long ones are cut, and which are refused."""

import re

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from service.pipeline.transform_names import TO, wire_name
from service.protocols.openigtlink.host import WireTool
from service.protocols.openigtlink.transforms import name_tools

SLUGS = st.from_regex(r"[a-z0-9]([a-z0-9-]{0,61}[a-z0-9])?", fullmatch=True)


@pytest.mark.parametrize(
    ("tool", "reference", "short", "full"),
    [
        ("probe", None, "probeToTracker", "probeToTracker"),
        ("probe", "patient", "probeToPatient", "probeToPatient"),
        ("probe", "2nd", "probeTo2nd", "probeTo2nd"),
        ("a-very-long-pointer", None, "a-very-longToTracker", "a-very-long-pointerToTracker"),
        ("needle", "patients-head", "needleToPatients-hea", "needleToPatients-head"),
        ("long-needle", "patients-head", "long-needToPatients-", "long-needleToPatients-head"),
    ],
)
def test_names(tool: str, reference: str | None, short: str, full: str):
    name = wire_name(tool, reference)
    assert (name.short, name.full) == (short, full)
    assert name.frame == reference


@example("0", "to")
@example("0", "tool")
@example("0", "to-1")
@example("0", "to2")
@given(SLUGS, st.none() | SLUGS)
def test_a_name_fits_and_has_one_to(tool, reference):
    name = wire_name(tool, reference)
    assert len(name.short.encode()) <= 20
    # As PLUS looks for it: by what is behind it, so that "Tool" has none.
    tos = [len(re.findall(f"{TO}(?=[^a-z])", one)) for one in (name.short, name.full)]
    others = [] if reference in (None, tool) else [WireTool(reference, "sim")]
    if tool in name_tools([WireTool(tool, "sim", reference), *others]).refused:
        assert tool == reference or tos == [2, 2]
        return
    assert tos == [1, 1]
    assert re.fullmatch(r"[a-z0-9-]+To[^a-z][a-zA-Z0-9-]*", name.short)
    if len(name.full) <= 20:
        assert name.short == name.full
    else:
        assert len(name.short) == 20


@given(st.lists(st.tuples(SLUGS, st.none() | SLUGS), unique_by=lambda one: one[0], max_size=8))
def test_no_two_tools_have_one_name(given_tools):
    naming = name_tools([WireTool(tool, "sim", reference) for tool, reference in given_tools])
    shorts = [name.short for name in naming.names.values()]
    assert len(set(shorts)) == len(shorts)
    assert set(naming.names) | set(naming.refused) == {tool for tool, _ in given_tools}
    assert not set(naming.names) & set(naming.refused)


def test_all_whose_names_clash_are_refused_and_others_are_not():
    tools = [WireTool(f"biopsy-needle-{size}", "sim") for size in ("a", "b")]
    naming = name_tools([*tools, WireTool("probe", "sim")])
    assert set(naming.names) == {"probe"}
    for tool in tools:
        assert "biopsy-needle-a, biopsy-needle-b" in naming.refused[tool.id]


@pytest.mark.parametrize(
    ("tool", "why"),
    [
        (WireTool("MyTool", "sim"), "To"),
        (WireTool("probe", "sim", "nobody"), "nobody"),
        (WireTool("probe", "sim", "probe"), "itself"),
        (WireTool("Tracker", "sim"), "tracker"),
        (WireTool("süd", "sim"), "ASCII"),
    ],
)
def test_what_cannot_be_a_frame_is_refused(tool: WireTool, why: str):
    naming = name_tools([tool])
    assert not naming.names
    assert why in naming.refused[tool.id]
