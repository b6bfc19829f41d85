"""GET /docs: the service's OpenAPI document as one page, written here and now: no scripts, nothing
from elsewhere.
"""

import re
from collections.abc import Iterator
from html import escape
from typing import Any

from fastapi import FastAPI
from fastapi.responses import HTMLResponse

from serve.api.console import HEADERS

PATH = "/docs"
HEAD = """<!doctype html>
<html lang="en">
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="color-scheme" content="light dark">
<title>driverview: the service</title>
<link rel="icon" href="data:,">
<link rel="stylesheet" href="console/console.css">
<link rel="stylesheet" href="console/docs.css">
"""


def add_docs(app: FastAPI) -> None:
    """Serve the page; it is written anew for each who asks, from what the application says then."""

    @app.get(PATH, include_in_schema=False)
    def docs() -> HTMLResponse:
        return HTMLResponse(page(app.openapi()), headers=HEADERS)


def page(document: dict[str, Any]) -> str:
    """An OpenAPI document as HTML."""
    info, paths = document["info"], document["paths"]
    operations = [
        (path, method, operation)
        for path, item in paths.items()
        for method, operation in item.items()
    ]
    schemas = document.get("components", {}).get("schemas", {})
    return "\n".join(
        [
            f"{HEAD}<header><h1>{_text(info['title'])} {_text(info['version'])}</h1>",
            f"<p>{_text(info.get('description', ''))}</p></header>",
            '<main class="docs">',
            *_contents(operations, schemas),
            *(line for operation in operations for line in _operation(*operation)),
            *(line for name, schema in schemas.items() for line in _schema(name, schema)),
            "</main></html>",
        ]
    )


def _contents(
    operations: list[tuple[str, str, dict[str, Any]]], schemas: dict[str, Any]
) -> Iterator[str]:
    yield '<nav aria-label="Contents"><ul>'
    for path, method, operation in operations:
        link = f'<a href="#{_anchor(method, path)}">{method.upper()} {_text(path)}</a>'
        yield f"<li>{link} {_text(operation.get('summary', ''))}"
    yield "<li>Schemas: " + ", ".join(f'<a href="#{_text(s)}">{_text(s)}</a>' for s in schemas)
    yield '<li><a href="openapi.json">openapi.json</a>, <a href="./">console</a></ul></nav>'


def _operation(path: str, method: str, operation: dict[str, Any]) -> Iterator[str]:
    yield f'<section id="{_anchor(method, path)}"><h2>{method.upper()} {_text(path)}</h2>'
    yield f"<p>{_text(operation.get('summary', ''))}</p>"
    if "description" in operation:
        yield f"<p>{_text(operation['description'])}</p>"
    yield from _table("Parameters", ("name", "in", "type", ""), _parameters(operation))
    body = operation.get("requestBody")
    if body is not None:
        yield f"<h3>Body</h3><p>{_text(body.get('description', ''))}</p>"
        yield from _table("", ("media type", "type"), _contents_of(body))
    yield from _table("Responses", ("status", "media types", "type", ""), _responses(operation))
    yield "</section>"


def _parameters(operation: dict[str, Any]) -> Iterator[tuple[str, ...]]:
    for found in operation.get("parameters", []):
        name = f"<code>{_text(found['name'])}</code>"
        kind = _type(found.get("schema", {}))
        yield name, _text(found["in"]), kind, _text(found.get("description", ""))


def _contents_of(body: dict[str, Any]) -> Iterator[tuple[str, ...]]:
    for name, content in body.get("content", {}).items():
        yield _text(name), _type(content.get("schema", {}))


def _responses(operation: dict[str, Any]) -> Iterator[tuple[str, ...]]:
    for status, response in operation["responses"].items():
        content = response.get("content", {})
        # One type said once, whatever the media types that it can be had in.
        types = dict.fromkeys(_type(found.get("schema", {})) for found in content.values())
        names = ", ".join(map(_text, content))
        yield _text(status), names, " or ".join(types), _text(response.get("description", ""))


def _schema(name: str, schema: dict[str, Any]) -> Iterator[str]:
    yield f'<section id="{_text(name)}"><h2>{_text(name)}</h2>'
    yield f"<p>{_text(schema.get('description', ''))}</p>"
    rows = (
        (f"<code>{_text(key)}</code>", _type(found), _text(found.get("description", "")))
        for key, found in schema.get("properties", {}).items()
    )
    yield from _table("", ("member", "type", ""), rows)
    yield "</section>"


def _table(title: str, columns: tuple[str, ...], rows: Iterator[tuple[str, ...]]) -> Iterator[str]:
    """A table of cells that are HTML already; nothing where there are no rows."""
    found = list(rows)
    if not found:
        return
    if title:
        yield f"<h3>{title}</h3>"
    yield "<table><thead><tr>" + "".join(f'<th scope="col">{c}' for c in columns) + "</thead>"
    yield from ("<tr>" + "".join(f"<td>{cell}" for cell in row) for row in found)
    yield "</table>"


def _type(schema: dict[str, Any]) -> str:
    """A schema in a few words, as HTML."""
    if "$ref" in schema:
        name = _text(schema["$ref"].rpartition("/")[2])
        return f'<a href="#{name}">{name}</a>'
    for key in ("anyOf", "oneOf"):
        if key in schema:
            return " or ".join(map(_type, schema[key]))
    if "enum" in schema:
        return "one of " + ", ".join(f"<code>{_text(value)}</code>" for value in schema["enum"])
    kind = str(schema.get("type", "any"))
    if kind == "array":
        return f"list of {_type(schema.get('items', {}))}{_bounds(schema, 'Items')}"
    if kind == "string":
        return f"{_text(schema.get('format', 'string'))}{_bounds(schema, 'Length')}"
    return f"{_text(kind)}{_bounds(schema, 'imum')}"


def _bounds(schema: dict[str, Any], name: str) -> str:
    low, high = schema.get(f"min{name}"), schema.get(f"max{name}")
    if low is not None and low == high:
        return f", {low}"
    return (f", from {low}" if low is not None else "") + (f" to {high}" if high else "")


def _anchor(method: str, path: str) -> str:
    return re.sub("[^a-z0-9]+", "-", f"{method}{path}".lower()).strip("-")


def _text(value: object) -> str:
    """Text as HTML, with what stands in `backticks` as code."""
    return re.sub("`([^`]*)`", r"<code>\1</code>", escape(str(value)))
