"""Parses the project's HTML pages: their elements, and whether each is closed."""

import re
from dataclasses import dataclass, field
from html.parser import HTMLParser

VOID = {"meta", "img", "br", "link", "input", "hr"}
UNCLOSED = {"html", "head", "body", "p", "tr", "td", "th", "thead", "tbody", "li"}
"""Elements whose end tag may be omitted in HTML."""
CELLS = ("td", "th")
ENDS = {
    "td": CELLS,
    "th": CELLS,
    "tr": (*CELLS, "tr"),
    "tbody": (*CELLS, "tr", "thead"),
    "p": ("p",),
    "table": ("p",),
}
"""By element: the open elements that its start tag closes."""


@dataclass
class Element:
    tag: str
    attributes: dict[str, str]
    text: str = ""
    inside: list[str] = field(default_factory=list)
    """Enclosing tags, outermost first."""

    def has_class(self, name: str) -> bool:
        return name in self.attributes.get("class", "").split()


class Page(HTMLParser):
    """The elements of a page in order. Raises AssertionError when one is not closed."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.source = text
        self.elements: list[Element] = []
        self._open: list[Element] = []
        self.feed(text)
        self.close()
        left = [one.tag for one in self._open if one.tag not in UNCLOSED]
        assert not left, f"never closed: {left}"

    def all(self, tag: str, kind: str | None = None) -> list[Element]:
        """Elements with this `tag` and class `kind`."""
        return [e for e in self.elements if e.tag == tag and (kind is None or e.has_class(kind))]

    def rows(self, table: int) -> list[list[str]]:
        """The cells of a table's rows."""
        return self._tables[table]

    def require_self_contained(self) -> None:
        """Raise AssertionError when the page needs the network or another file."""
        for element in self.elements:
            assert element.tag not in ("script", "link", "iframe", "object"), element
            for name in ("src", "href", "srcset", "action", "data"):
                value = element.attributes.get(name, "data:")
                assert value.startswith(("data:", "#")), (element.tag, name, value)
        assert not re.search(r"url\(|@import|https?:", self.source)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        while self._open and self._open[-1].tag in ENDS.get(tag, ()):
            self._open.pop()
        around = [one.tag for one in self._open]
        element = Element(tag, {name: value or "" for name, value in attrs}, inside=around)
        self.elements.append(element)
        if tag not in VOID:
            self._open.append(element)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.handle_starttag(tag, attrs)
        if tag not in VOID:
            self._open.pop()

    def handle_endtag(self, tag: str) -> None:
        while self._open and self._open[-1].tag != tag:
            assert self._open[-1].tag in UNCLOSED, f"<{self._open[-1].tag}> closed by </{tag}>"
            self._open.pop()
        assert self._open, f"</{tag}> closes nothing"
        self._open.pop()

    def handle_data(self, data: str) -> None:
        for element in self._open:
            element.text += data

    @property
    def _tables(self) -> list[list[list[str]]]:
        tables: list[list[list[str]]] = []
        for element in self.elements:
            if element.tag == "table":
                tables.append([])
            elif element.tag == "tr":
                tables[-1].append([])
            elif element.tag in ("td", "th"):
                tables[-1][-1].append(element.text.strip())
        return tables
