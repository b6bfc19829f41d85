"""Fills the reference pages from the code: MkDocs calls `on_page_markdown` for every page.

`<!-- generated: NAME -->` in a page is replaced by the Markdown that `GENERATORS[NAME]` returns.
"""

import ast
import inspect
import re
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
PACKAGES = ("trackfeatures", "runtime", "simulator", "datagen", "mtlnet", "serve", "controllers")
PROGRAMS = ("simulator", "datagen", "mtlnet", "serve", "controllers")
MARKER = re.compile(r"<!-- generated: (\w+) -->")


def on_page_markdown(markdown: str, **_: object) -> str:
    """The page with its markers replaced; a marker of an unknown name raises KeyError."""
    return MARKER.sub(lambda marker: GENERATORS[marker.group(1)](), markdown)


def commands() -> str:
    """Every command and subcommand with its arguments and options."""
    parts = []
    for program in PROGRAMS:
        parts.append(f"## {program}")
        for words, command in _tree((program,), _click(program)):
            parts += _describe(words, command)
    return "\n\n".join(parts)


def _click(program: str) -> Any:
    import typer

    return typer.main.get_command(import_module(f"{program}.cli").app)


def _tree(words: tuple[str, ...], command: Any) -> Iterator[tuple[tuple[str, ...], Any]]:
    yield words, command
    for name, child in getattr(command, "commands", {}).items():
        yield from _tree((*words, name), child)


def _describe(words: tuple[str, ...], command: Any) -> list[str]:
    parts = [f"### {' '.join(words)}", inspect.cleandoc(command.help or "").replace("\x08\n", "")]
    shown = [p for p in command.params if p.name != "help" and not getattr(p, "hidden", False)]
    if shown:
        rows = ["| argument or option | default | meaning |", "|---|---|---|"]
        for p in shown:
            rows.append(f"| `{_name(p)}` | {_default(p)} | {_cell(getattr(p, 'help', ''))} |")
        parts.append("\n".join(rows))
    return parts


def _name(parameter: Any) -> str:
    option = parameter.param_type_name == "option"
    return str(max(parameter.opts, key=len) if option else parameter.name)


def _default(parameter: Any) -> str:
    shown = getattr(parameter, "show_default", None)
    if isinstance(shown, str):
        return shown
    value = parameter.default
    empty = value is None or value == "" or value is False or callable(value)
    return "" if empty or "Sentinel" in type(value).__name__ else f"`{value}`"


def _cell(text: str | None) -> str:
    return " ".join((text or "").split()).replace("|", "\\|").replace("<", "&lt;")


def _openapi() -> dict[str, Any]:
    from unittest.mock import MagicMock

    from serve.app import Service

    document: dict[str, Any] = Service(MagicMock()).framework.openapi()  # answers no request
    return document


def operations() -> str:
    """The operations of the OpenAPI document."""
    rows = ["| operation | answer |", "|---|---|"]
    for path, methods in _openapi()["paths"].items():
        for method, about in methods.items():
            rows.append(f"| `{method.upper()} {path}` | {_cell(about.get('summary'))} |")
    return "\n".join(rows)


def answer() -> str:
    """The fields of the answer of `POST /features`, those of its objects too."""
    schemas = _openapi()["components"]["schemas"]
    rows = ["| field | meaning |", "|---|---|"]
    for name, field in schemas["Features"]["properties"].items():
        schema = _object(schemas, field)
        about = (schema.get("description", "").rstrip("."), field.get("description"))
        rows.append(f"| `{name}` | {_cell('; '.join(filter(None, about)))} |")
        for part, found in schema.get("properties", {}).items():
            rows.append(f"| `{name}.{part}` | {_cell(found.get('description'))} |")
    return "\n".join(rows)


def _object(schemas: dict[str, Any], field: dict[str, Any]) -> dict[str, Any]:
    """The schema of the object that a field holds, {} where it holds none."""
    for kind in (field, *field.get("anyOf", ())):
        if "$ref" in kind:
            return dict(schemas[kind["$ref"].rpartition("/")[2]])
    return {}


def problems() -> str:
    """The types of problems by status."""
    from serve import problems as module

    kinds = sorted((k.status, k.name, k.title) for k in module.PROBLEM_TYPES)
    rows = ["| status | name | meaning |", "|---|---|---|"]
    return "\n".join(rows + [f"| {status} | `{name}` | {title} |" for status, name, title in kinds])


def messages() -> str:
    """The fields of every message of our own, with unit and frame."""
    from datagen.recording.schema.json_schema import json_schema

    parts = []
    for name, message in json_schema()["$defs"].items():
        rows = [f"### {name}\n", "| field | unit | meaning | frame, reference point | absent if |"]
        rows.append("|---|---|---|---|---|")
        for field, about in message["properties"].items():
            place = ", ".join(filter(None, map(about.get, ("x-frame", "x-reference-point"))))
            cells = (about.get("x-unit"), about["description"], place, about.get("x-absent"))
            rows.append(f"| `{field}` | " + " | ".join(_cell(c) for c in cells) + " |")
        parts.append("\n".join(rows))
    return "\n\n".join(parts)


def header() -> str:
    """The generated C header."""
    from simulator.link.header import c_header

    return f"```c\n{c_header()}\n```"


def errors() -> str:
    """The classes of errors that users meet, by package."""
    rows = ["| class | base classes | meaning |", "|---|---|---|"]
    for name, (module, bases, about) in sorted(error_classes().items()):
        rows.append(
            f"| `{module}.{name}` | {', '.join(f'`{b}`' for b in bases)} | {_cell(about)} |"
        )
    return "\n".join(rows)


def error_classes() -> dict[str, tuple[str, tuple[str, ...], str]]:
    """UserError and its subclasses by name: module, bases, first sentence of the docstring.

    Read from the sources, because an import of all modules takes a minute.
    """
    defined: dict[str, tuple[str, tuple[str, ...], str]] = {}
    for path in (path for package in PACKAGES for path in (ROOT / package).rglob("*.py")):
        module = ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            if isinstance(node, ast.ClassDef):
                bases = tuple(ast.unparse(base) for base in node.bases)
                about = (ast.get_docstring(node) or "").partition("\n\n")[0]
                defined[node.name] = (module, bases, about)
    found = {"UserError"}
    while more := {n for n, (_, bases, _) in defined.items() if found & set(bases)} - found:
        found |= more
    return {name: about for name, about in defined.items() if name in found}


GENERATORS = {
    "errors": errors,
    "commands": commands,
    "operations": operations,
    "answer": answer,
    "problems": problems,
    "messages": messages,
    "header": header,
}
