"""Reads TORCS parameter files (XML) from untrusted sources: no DTD, no entities, a size limit.

A file is a tree of sections, which contain numbers with a unit (`attnum`) and strings (`attstr`).
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
from simulator.track.torcs.units import LENGTH, RATIO, UNITS, Dimension, parse_unit

MAX_BYTES: Final = 4 * 2**20
"""Limit of a file's size; the largest track of TORCS 1.3.7 has 180 kB."""

_NUMBER = re.compile(
    r"\s*(0[xX][0-9a-fA-F]+|[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)\s*", re.ASCII
)
_STANDARD = r"default-(?:surfaces|objects)"
_DECLARATION = re.compile(rf"<!ENTITY\s+{_STANDARD}\s+SYSTEM\s+(?:\"[^\"]*\"|'[^']*')\s*>")
_REFERENCE = re.compile(rf"&{_STANDARD};")
_ENCODING = re.compile(rb"<\?xml[^>]*?encoding\s*=\s*[\"']([A-Za-z0-9._-]+)[\"']")


@dataclass(frozen=True)
class Section:
    """One section of a parameter file; unknown attributes are ignored."""

    element: Element
    file: Path

    @property
    def name(self) -> str:
        return self.element.get("name", "")

    def sections(self) -> Iterator["Section"]:
        """Yield the direct subsections in the order of the file."""
        for child in self.element.findall("section"):
            yield Section(child, self.file)

    def section(self, name: str) -> "Section | None":
        """Return the first direct subsection with this name, or None."""
        return next((child for child in self.sections() if child.name == name), None)

    def length(self, name: str) -> float | None:
        """Return the numeric attribute (`attnum`) `name` in m, None if absent. Raises TrackError
        unless it is a finite number with a unit of length or without a unit."""
        return self._number(name, LENGTH, "a length")

    def number(self, name: str) -> float | None:
        """Return the numeric attribute `name`: an angle (rad), a slope or a plain number; None if
        absent. Raises TrackError if it is not finite or has a unit of another kind."""
        return self._number(name, RATIO, "an angle, a ratio or a plain number")

    def _number(self, name: str, dimension: Dimension, expected: str) -> float | None:
        """Return the numeric attribute `name` in SI units, None if absent. Raises TrackError unless
        its unit has the `dimension`; `expected` describes the dimension in the message."""
        attribute = self._attribute("attnum", name)
        if attribute is None:
            return None
        text, unit = attribute.get("val", ""), attribute.get("unit", "")
        where = f"{self.file}: section {self.name!r}: {name}"
        value = _number_in(text)
        if not math.isfinite(value):
            raise TrackError(f"{where} is {text!r}, expected a finite number such as 12.5")
        try:
            read = parse_unit(unit)
        except KeyError as error:
            raise TrackError(
                f"{where} has the unit {unit!r}, and TORCS has no {error}; "
                f"it has {', '.join(UNITS)}, and products of them as in 'kg.m/s2'"
            ) from None
        if read is None:
            return value
        if read.dimension != dimension:
            raise TrackError(f"{where} has the unit {unit!r}, expected {expected}")
        return value * read.factor

    def text(self, name: str) -> str | None:
        """Return the string attribute (`attstr`) `name`, None if absent."""
        attribute = self._attribute("attstr", name)
        return None if attribute is None else attribute.get("val", "")

    def _attribute(self, kind: str, name: str) -> Element | None:
        # If a name occurs twice, the first one is used, as the heights of ruudskogen require.
        return next((c for c in self.element.findall(kind) if c.get("name") == name), None)


def _number_in(text: str) -> float:
    """Return the decimal or hexadecimal ("0x1f") number that is all of `text`; NaN for other texts.

    TORCS reads "1,5" and "1.5.2" as far as it can, and an empty text as 0. This function returns
    NaN for these texts.
    """
    found = _NUMBER.fullmatch(text)
    if found is None:
        return math.nan
    digits = found[1]
    try:
        return float(int(digits, 16)) if digits[:2] in ("0x", "0X") else float(digits)
    except OverflowError:  # a hexadecimal number beyond the largest float
        return math.inf


def read_parameter_file(path: Path) -> Section:
    """Return the root section of a TORCS parameter file.

    Raises TrackError for a file that is too large, not XML, incomplete, or that declares entities
    other than TORCS's two standard lists. Those two are removed; no other file is opened.
    """
    size = path.stat().st_size
    if size > MAX_BYTES:
        raise TrackError(f"{path}: {size} bytes; a TORCS track file has at most {MAX_BYTES}")
    text = _REFERENCE.sub("", _DECLARATION.sub("", _decode(path.read_bytes(), path)))
    # A DOCTYPE is allowed, since expat never opens the DTD that it names; entities are refused.
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
    """Decode a file's bytes with the encoding that it declares, by default UTF-8."""
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
