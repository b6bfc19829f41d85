"""Generates the link's C header. It consists of the hand-written parts in the folder c/ and of
constants, enumerations and structs generated from `layout`."""

from enum import IntEnum
from importlib.resources import files

from simulator.link import layout
from simulator.link.layout import Block, Field


def c_header() -> str:
    """Return the text of `driverview_link.h`, with which a C program connects to a link server."""
    parts = [_read("top.h"), _constants(), *(_enumeration(kind) for kind in layout.ENUMS)]
    parts.append(_read("assert.h"))
    parts += [_struct(block) for block in layout.BLOCKS]
    parts += [_assertions(block) for block in layout.BLOCKS]
    parts.append(_read("protocol.h"))
    return "".join(parts) + "\n#endif\n"


def _read(name: str) -> str:
    return files("simulator.link").joinpath("c", name).read_text()


def _constants() -> str:
    values = {
        "MAGIC": f'"{layout.MAGIC.rstrip(bytes(1)).decode()}"',
        "VERSION": f"{layout.VERSION}u",
        "LAYOUT_HASH": f"0x{layout.layout_hash():016x}ull",
        "BYTE_ORDER": f"0x{layout.BYTE_ORDER:08x}u",
        "BEAMS": str(layout.BEAMS),
        **{f"{block.name.upper()}_OFFSET": str(block.offset) for block in layout.BLOCKS},
        "IMAGE_OFFSET": str(layout.IMAGE_OFFSET),
    }
    return "".join(f"#define DRVLINK_{name} {value}\n" for name, value in values.items()) + "\n"


def _enumeration(kind: type[IntEnum]) -> str:
    name = kind.__name__.lower()
    members = "".join(f"    DRVLINK_{name.upper()}_{m.name} = {m.value},\n" for m in kind)
    return f"/* {kind.__doc__} */\nenum drvlink_{name} {{\n{members}}};\n\n"


def _struct(block: Block) -> str:
    lines = [f"    {_declaration(field):28} /* {_comment(field)} */\n" for field in block.fields]
    return f"/* {block.meaning} */\nstruct drvlink_{block.name} {{\n{''.join(lines)}}};\n\n"


def _declaration(field: Field) -> str:
    many = f"[{field.count}]" if field.count > 1 or field.kind == "char" else ""
    return f"{layout.C_TYPES[field.kind]} {field.name}{many};"


def _comment(field: Field) -> str:
    return f"{field.unit}, {field.meaning}" if field.unit not in ("", "1") else field.meaning


def _assertions(block: Block) -> str:
    """Return C code of static assertions that the compiler's offsets of the fields of `block` equal
    the offsets of the layout."""
    struct = f"struct drvlink_{block.name}"
    lines = [
        f"DRVLINK_ASSERT(offsetof({struct}, {name}) == {offset});\n"
        for name, (offset, _) in block.places.items()
    ]
    return "".join(lines) + f"DRVLINK_ASSERT(sizeof({struct}) == {block.dtype.itemsize});\n\n"
