"""Renders self-contained HTML pages from jinja2 templates; text is escaped, images are embedded.

The template of a page extends `page_shell.html` (style sheet, title) and can import the table macro
of `macros.html`.
"""

import base64
from typing import Any

import numpy as np
import simplejpeg
from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined
from numpy.typing import NDArray

JPEG_QUALITY = 80


def render(package: str, template: str, **values: Any) -> str:
    """Render `template`, a file of `package`, to HTML. Text in `values` is escaped.

    Values that already are HTML (charts) must be `markupsafe.Markup`. Raises jinja2.UndefinedError
    if the template uses a value that is not given.
    """
    environment = Environment(
        loader=ChoiceLoader([PackageLoader(package, ""), PackageLoader("runtime", "")]),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=StrictUndefined,
    )
    environment.filters.update(number=format_number, percent=format_percent)
    environment.policies["json.dumps_kwargs"] = {"separators": (",", ":")}
    return environment.get_template(template).render(**values)


def format_number(value: float | None, digits: int) -> str:
    """Format `value` with `digits` decimal places; "-" for None."""
    return "-" if value is None else f"{value:.{digits}f}"


def format_percent(share: float | None, digits: int = 1) -> str:
    """Format `share` in [0, 1] as a percentage with `digits` decimal places; "-" for None."""
    return "-" if share is None else f"{share:.{digits}%}"


def data_uri(content: bytes, media_type: str = "image/jpeg") -> str:
    """Return a `data:` URI that contains `content`, the bytes of a file of type `media_type`."""
    return f"data:{media_type};base64,{base64.b64encode(content).decode()}"


def embed_jpeg(image: NDArray[np.uint8]) -> str:
    """Encode an image (H, W, 3) uint8 RGB as JPEG and return it as a `data:` URI."""
    return data_uri(simplejpeg.encode_jpeg(np.ascontiguousarray(image), quality=JPEG_QUALITY))
