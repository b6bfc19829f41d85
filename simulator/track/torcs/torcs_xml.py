"""Reads TORCS parameter files (XML) without trusting them: no DTD, no entities, a size limit.

A file is a tree of sections that hold numbers with a unit (`attnum`) and strings (`attstr`).
"""

import codecs
import math
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final
from xml.etree.ElementTree import Element, ParseError

from defusedxml import DefusedXmlException
from defusedxml.ElementTree import DefusedXMLParser

from simulator.track.errors import TrackError

MAX_BYTES: Final = 4 * 2**20
"""The largest track of TORCS 1.3.7 has 180 kB."""

UNITS: Final = {
    "": 1.0,
    "none": 1.0,
    "SI": 1.0,
    "m": 1.0,
    "rad": 1.0,
    "ft": 0.304801,  # as the program has it, not 0.3048
    "deg": math.pi / 180.0,
    "%": 0.01,
}

_STANDARD = r"default-(?:surfaces|objects)"
_DECLARATION = re.compile(rf"<!ENTITY\s+{_STANDARD}\s+SYSTEM\s+(?:\"[^\"]*\"|'[^']*')\s*>")
_REFERENCE = re.compile(rf"&{_STANDARD};")
_ENCODING = re.compile(rb"<\?xml[^>]*?encoding\s*=\s*[\"']([A-Za-z0-9._-]+)[\"']")


@dataclass(frozen=True)
class Section:
    """One section of a parameter file; attributes that nobody asks for are ignored."""

    element: Element
    file: Path

    @property
    def name(self) -> str:
        return self.element.get("name", "")

    def sections(self) -> Iterator["Section"]:
        """The direct subsections, in the order of the file."""
        for child in self.element.findall("section"):
            yield Section(child, self.file)

    def section(self, name: str) -> "Section | None":
        """The first direct subsection of that name."""
        return next((child for child in self.sections() if child.name == name), None)

    def number(self, name: str) -> float | None:
        """An `attnum` in SI units, None where absent; TrackError unless it is a finite number."""
        attribute = self._attribute("attnum", name)
        if attribute is None:
            return None
        text, unit = attribute.get("val", ""), attribute.get("unit", "")
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise TrackError(
                f"{self.file}: section {self.name!r}: {name} is {text!r}, expected a finite number"
            )
        if unit not in UNITS:
            known = ", ".join(repr(u) for u in UNITS if u)
            raise TrackError(
                f"{self.file}: section {self.name!r}: {name} has the unit {unit!r}, "
                f"expected one of {known}"
            )
        return value * UNITS[unit]

    def text(self, name: str) -> str | None:
        """An `attstr`, None where absent."""
        attribute = self._attribute("attstr", name)
        return None if attribute is None else attribute.get("val", "")

    def _attribute(self, kind: str, name: str) -> Element | None:
        # The first one wins where a name is given twice: so the program has ruudskogen's heights.
        return next((c for c in self.element.findall(kind) if c.get("name") == name), None)


def read_parameter_file(path: Path) -> Section:
    """The root section of a TORCS parameter file.

    Raises TrackError for a file that is too large, not XML, cut short, or that declares entities
    other than TORCS's two standard lists; those two are dropped, and nothing else is opened.
    """
    size = path.stat().st_size
    if size > MAX_BYTES:
        raise TrackError(f"{path}: {size} bytes; a TORCS track file has at most {MAX_BYTES}")
    text = _REFERENCE.sub("", _DECLARATION.sub("", _decode(path.read_bytes(), path)))
    # The DOCTYPE stays (it may name a DTD, which expat never opens); entities are refused.
    parser = DefusedXMLParser(forbid_dtd=False, forbid_entities=True, forbid_external=True)
    try:
        parser.feed(text)
        root = parser.close()
    except DefusedXmlException as error:
        raise TrackError(
            f"{path}: declares or loads XML entities ({type(error).__name__}), which are not "
            "allowed in a track file; remove the <!ENTITY ...> lines and their uses"
        ) from None
    except (ParseError, ValueError) as error:
        raise TrackError(
            f"{path}: not a readable XML file ({error}); is it cut short, or not a track at all?"
        ) from None
    if root.tag != "params":
        raise TrackError(f"{path}: the root element is <{root.tag}>, a TORCS file has <params>")
    return Section(root, path)


def _decode(data: bytes, path: Path) -> str:
    encoding = "utf-8-sig"
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        encoding = "utf-16"
    elif declared := _ENCODING.search(data[:200]):
        name = declared.group(1).decode("ascii")
        encoding = "utf-8-sig" if name.lower() in ("utf-8", "utf8") else name
    try:
        return data.decode(encoding)
    except (UnicodeError, LookupError) as error:
        raise TrackError(f"{path}: cannot be read as text ({error}); is it an XML file?") from None
