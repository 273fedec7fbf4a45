"""Public functions of ``compute`` describe their arguments."""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


@pytest.mark.slow
def test_public_function_of_two_arguments_describes_them() -> None:
    functions = [
        (f"{path.relative_to(ROOT)}:{function.lineno} {function.name}", function)
        for path in sorted((ROOT / "compute").rglob("*.py"))
        for function in public_functions(ast.parse(path.read_text(encoding="utf-8")))
        if len(arguments(function)) >= 2
    ]
    assert functions
    assert [
        place
        for place, function in functions
        if "Args:" not in (ast.get_docstring(function) or "").splitlines()
    ] == []


def public_functions(parent: ast.Module | ast.ClassDef) -> Iterator[ast.FunctionDef]:
    """Yield the functions of a module, and the methods of its classes."""
    for node in parent.body:
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
            yield from public_functions(node)
        elif isinstance(node, ast.FunctionDef) and not node.name.startswith("_"):
            yield node


def arguments(function: ast.FunctionDef) -> list[str]:
    declared = function.args
    names = [one.arg for one in (*declared.posonlyargs, *declared.args, *declared.kwonlyargs)]
    return [one for one in names if one not in ("self", "cls") and not one.startswith("_")]
