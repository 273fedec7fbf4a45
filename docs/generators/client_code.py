"""Code of the Python client that follows from the OpenAPI document: methods, answers, bodies.

Usage: .venv/bin/python docs/generators/client_code.py (after a change of the interface).
"""

import keyword
import re
import subprocess
import sys
import textwrap
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final

from pydantic import BaseModel

Schema = Mapping[str, Any]
ROOT: Final = Path(__file__).parents[2]
FOLDER: Final = ROOT / "lumiline" / "client"
PAGING: Final = frozenset({"limit", "cursor"})
WAITS_S: Final = {
    "capture-target": 60.0,
    "capture-radiometric-frames": 120.0,
    "create-registration": 60.0,
}
"""How long the server may measure or compute [s], where the body does not say."""

_NOTE: Final = (
    "# Made from the OpenAPI document by docs/generators/client_code.py; edit nothing here.\n"
)


def generate(document: Schema) -> dict[str, str]:
    """Return the modules' code by file name, before it is formatted."""
    names = _type_names(document)
    answers, bodies = _Types(document, names, answers=True), _Types(document, names, answers=False)
    methods = "".join(
        f"\n{_method(path, verb.upper(), operation, answers, bodies)}"
        for path, verbs in document["paths"].items()
        for verb, operation in verbs.items()
    )
    models = "".join(answers.definitions)
    typed_bodies = "".join(bodies.definitions)
    return {
        "models.py": _MODELS_HEAD + models,
        "bodies.py": _BODIES_HEAD + typed_bodies,
        "operations.py": _OPERATIONS_HEAD + textwrap.indent(methods, "    "),
    }


def method_name(operation_id: str) -> str:
    """Return the client's method for an operation: ``list-`` and ``get-`` are left out."""
    return re.sub(r"^(list|get)-", "", operation_id).replace("-", "_")


def _type_names(document: Schema) -> dict[str, str]:
    """Names of the types by those of their schemas, which may have their module's before them."""
    schemas = document["components"]["schemas"]
    short = [name.rsplit("__", 1)[-1] for name in schemas]
    names = {}
    for name in schemas:
        *modules, last = name.split("__")
        if modules and short.count(last) > 1:
            of = [part for part in modules if part != "schema"][-1].removesuffix("_schema")
            last = of.title().replace("_", "") + last
        names[name] = last
    return names


class _Types:
    """Types of a kind, as code, with the definitions that they need in the order of their use."""

    def __init__(self, document: Schema, names: Mapping[str, str], *, answers: bool) -> None:
        self._schemas = document["components"]["schemas"]
        self._names = names
        self._answers = answers
        self._defined: dict[str, str] = {}
        self.definitions: list[str] = []

    def of(self, schema: Schema) -> str:
        """Return a schema's type; ``Any`` where it says nothing."""
        if "$ref" in schema:
            return self._named(schema["$ref"].rsplit("/", 1)[-1])
        for several in ("anyOf", "oneOf"):
            if several in schema:
                return " | ".join(dict.fromkeys(self.of(one) for one in schema[several]))
        if "const" in schema:
            return f"Literal[{schema['const']!r}]"
        if "enum" in schema:
            # A newer server may have further values.
            return "str" if self._answers else f"Literal{schema['enum']!r}"
        match schema.get("type"):
            case "string":
                return "datetime" if schema.get("format") == "date-time" else "str"
            case "integer" | "number" | "boolean" | "null" as kind:
                return _SCALARS[kind]
            case "array":
                return self._array(schema)
            case "object":
                members = schema.get("additionalProperties", True)
                value = self.of(members) if isinstance(members, Mapping) else "Any"
                return f"{'dict' if self._answers else 'Mapping'}[str, {value}]"
        return "Any"

    def _array(self, schema: Schema) -> str:
        items = [self.of(item) for item in schema.get("prefixItems", ())]
        if not items:
            item = self.of(schema.get("items", {}))
            return f"tuple[{item}, ...]" if self._answers else f"Sequence[{item}]"
        if self._answers:
            return f"tuple[{', '.join(items)}]"
        return f"Sequence[{' | '.join(dict.fromkeys(items))}]"

    def _named(self, name: str) -> str:
        schema = self._schemas[name]
        if "properties" not in schema:
            return self.of(schema)
        if name not in self._defined:
            self._defined[name] = self._names[name]
            code = self._define(self._names[name], schema)
            self.definitions.append(code)
        return self._defined[name]

    def body(self, schema: Schema) -> str:
        """Return the TypedDict of a body; one with the members of all, where there are several."""
        name = schema["$ref"].rsplit("/", 1)[-1]
        whole = self._schemas[name]
        if "oneOf" not in whole:
            return self._named(name)
        kinds = [self._schemas[one["$ref"].rsplit("/", 1)[-1]] for one in whole["oneOf"]]
        members: dict[str, list[Schema]] = {}
        for kind in kinds:
            for member, value in kind["properties"].items():
                known = members.setdefault(member, [])
                if value not in known:
                    known.append(value)
        required = set.intersection(*(set(kind.get("required", ())) for kind in kinds))
        merged = {
            "description": whole["description"],
            "required": sorted(required),
            "properties": {member: {"anyOf": values} for member, values in members.items()},
        }
        self.definitions.append(self._define(self._names[name], merged))
        return self._names[name]

    def _define(self, name: str, schema: Schema) -> str:
        required = schema.get("required", ())
        lines = [f"class {name}({'ResponseModel' if self._answers else 'TypedDict'}):"]
        lines += [f'    """{_sentence(schema.get("description", ""), name)}"""', ""]
        for member, value in schema["properties"].items():
            if not member.isidentifier() or keyword.iskeyword(member) or hasattr(BaseModel, member):
                raise ValueError(f"{name}.{member} is no name of an attribute")
            kind = self.of(value)
            if self._answers:
                default = "" if member in required else f" = {_default(value)}"
                if default.endswith("None") and not kind.endswith("None"):
                    kind += " | None"
                lines.append(f"    {member}: {kind}{default}")
            else:
                lines.append(
                    f"    {member}: {kind if member in required else f'NotRequired[{kind}]'}"
                )
        return "\n".join(lines) + "\n\n\n"


def _default(schema: Schema) -> str:
    value = schema.get("default")
    return repr(tuple(value) if isinstance(value, list) else value)


def _sentence(description: str, otherwise: str) -> str:
    """First paragraph of a description, in one line where it fits."""
    text = " ".join(description.split("\n\n")[0].split()) or f"{otherwise}."
    lines = textwrap.wrap(re.sub(r"(?<!`)`([^`]+)`(?!`)", r"``\1``", text), 88)
    return "\n    ".join(lines) + ("\n    " if len(lines) > 1 else "")


def _method(path: str, verb: str, operation: Schema, answers: _Types, bodies: _Types) -> str:
    """Code of the method of one operation."""
    parameters = [
        # Left out, the client sends the ETag that it read.
        one | {"required": False} if one["name"] == "If-Match" else one
        for one in operation.get("parameters", [])
        if one["name"] != "If-None-Match"
    ]
    content = operation.get("requestBody", {}).get("content", {})
    media, reply = _reply(operation)
    is_list = re.fullmatch(r".*/Page_.*_", reply.get("$ref", "")) is not None
    at = re.findall(r"{(\w+)}", path)
    positional = [f"{name}: str" for name in at]
    keywords = list(_keywords(parameters, bodies, is_list=is_list))
    sent = []
    if "application/json" in content:
        # Members of a body may have the names of the path.
        positional += ["/"] * bool(at)
        body = bodies.body(content["application/json"]["schema"])
        keywords.append(f"**members: Unpack[bodies.{body}]")
        sent.append("body=members")
    elif content:
        positional.append("file: Path | str")
        sent.append("upload=file")
    if media == "file":
        positional.insert(len(at), "file: Path | str")
    for where, argument in (("query", "params"), ("header", "headers")):
        named = ", ".join(
            f"{one['name']!r}: {_argument(one)}"
            for one in parameters
            if one["in"] == where and one["name"] not in PAGING
        )
        if named:
            sent.append(f"{argument}={{{named}}}")
    if (wait_s := WAITS_S.get(operation["operationId"])) is not None:
        sent.append(f"extra_timeout_s={wait_s}")
    star = ["*"] if keywords and not keywords[0].startswith("**") else []
    signature = ", ".join(["self", *positional, *star, *keywords])
    name = method_name(operation["operationId"])
    template = repr(re.sub(r"{\w+}", "{}", path))
    where = f"path_of({', '.join([template, *at])})" if at else template
    call, kind = _call(media, reply, verb, answers, is_list=is_list)
    said = f'"""{operation["summary"].rstrip(".")}."""'
    return (
        f"@ClientMethod\nasync def {name}({signature}) -> {kind}:\n"
        f"    {said}\n    {call.format(arguments=', '.join([where, *sent]))}\n"
    )


def _reply(operation: Schema) -> tuple[str, Schema]:
    """Return whether an operation answers ``json``, a ``file``, ``text`` or nothing; its schema."""
    success = next(one for code, one in operation["responses"].items() if code.startswith("2"))
    content = success.get("content", {})
    if "application/json" in content:
        return "json", content["application/json"]["schema"]
    if not content:
        return "", {}
    return "text" if "text/plain" in content else "file", {}


def _keywords(parameters: list[Schema], types: _Types, *, is_list: bool) -> Iterator[str]:
    for one in sorted(parameters, key=lambda one: not one.get("required", False)):
        if one["in"] == "path" or one["name"] in PAGING:
            continue
        kind = types.of(one["schema"])
        if one.get("required"):
            yield f"{_argument(one)}: {kind}"
        else:
            kind = kind if kind.endswith("None") else f"{kind} | None"
            yield f"{_argument(one)}: {kind} = None"
    if is_list:
        yield "limit: int | None = None"


def _argument(parameter: Schema) -> str:
    name: str = parameter["name"].lower().replace("-", "_")
    return name


def _call(
    media: str, reply: Schema, verb: str, answers: _Types, *, is_list: bool
) -> tuple[str, str]:
    """Return the method's last statement and the type of its result."""
    if media == "file":
        return f"return await self._download({verb!r}, file, {{arguments}})", "Path"
    if media == "text":
        return f"return await self._text({verb!r}, {{arguments}})", "str"
    if not media:
        return f"await self._request({verb!r}, {{arguments}})", "None"
    if is_list:
        name = re.sub(r".*/Page_(.*)_", r"#/components/schemas/\1", reply["$ref"])
        kind = f"models.{answers.of({'$ref': name})}"
        return f"return await self._get_all({kind}, {{arguments}}, limit=limit)", f"list[{kind}]"
    kind = answers.of(reply)
    kind = re.sub(r"\b(?!tuple\b|dict\b|str\b|Any\b)([A-Za-z]\w*)", r"models.\1", kind)
    return f"return await self._send({kind}, {verb!r}, {{arguments}})", kind


_SCALARS: Final = {"integer": "int", "number": "float", "boolean": "bool", "null": "None"}

_MODELS_HEAD: Final = f'''\
"""Models of the server's answers; further members of a newer server become attributes."""
{_NOTE}
from datetime import datetime
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict


class ResponseModel(BaseModel):
    """Base of the models of the server's answers."""

    model_config = ConfigDict(
        frozen=True, extra="allow", defer_build=True, protected_namespaces=()
    )


'''
_BODIES_HEAD: Final = f'''\
"""Members of the bodies of requests; mypy and editors check the client's methods by them."""
{_NOTE}
from collections.abc import Mapping, Sequence
from datetime import datetime
from typing import Any, Literal, NotRequired, TypedDict


'''
_OPERATIONS_HEAD: Final = f'''"""A method for each operation of the server's interface."""
{_NOTE}# ruff: noqa: A002  (parameters have the interface's names)
from datetime import datetime
from pathlib import Path
from typing import Any, Literal, Unpack

from lumiline.client import bodies, models
from lumiline.client.exchange import ClientMethod, Exchanges, path_of


class Operations(Exchanges):
    """A method for each operation of the server's interface; raises what ``request`` does.

    ``limit``: at most this many items of a list, None: all. ``members``: those of the body, as in
    the server's documentation.
    """
'''


def formatted(code: str, name: str) -> str:
    """Return code as the linter wants it."""
    ruff = Path(sys.executable).with_name("ruff")
    options = ["--config", str(ROOT / "pyproject.toml"), "--stdin-filename", str(FOLDER / name)]
    fixed = subprocess.run(
        [ruff, "check", "--fix", "--quiet", "--select", "F401,I", *options, "-"],
        input=code, capture_output=True, text=True, check=True,
    ).stdout  # fmt: skip
    return subprocess.run(
        [ruff, "format", "--quiet", *options, "-"],
        input=fixed, capture_output=True, text=True, check=True,
    ).stdout  # fmt: skip


def main() -> None:
    """Write the modules, or check that they are as they would be written."""
    from service.application.app import create_app
    from service.settings import Settings

    document = create_app(Settings()).openapi()
    for name, raw in generate(document).items():
        file, code = FOLDER / name, formatted(raw, name)
        if "--check" not in sys.argv:
            file.write_text(code)
        elif file.read_text() != code:
            sys.exit(f"{name} is of another interface; run docs/generators/client_code.py")


if __name__ == "__main__":
    main()
