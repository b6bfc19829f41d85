"""The page at /docs: all of the OpenAPI document, and nothing from elsewhere."""

import re
import shutil
import subprocess
from html import unescape
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pytest

from serve.api.docs import page
from serve.config import Limits
from tests.serve.conftest import FakeEngine, Served, outputs, serving

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")


class Found(HTMLParser):
    """The text, the links, the names and the tags of a page."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.words: list[str] = []
        self.links: list[str] = []
        self.ids: list[str] = []
        self.tags: set[str] = set()
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.add(tag)
        named = dict(attrs)
        self.links += [value for name in ("href", "src") if (value := named.get(name))]
        self.ids += [value for value in [named.get("id")] if value]

    def handle_data(self, data: str) -> None:
        self.words.append(data)

    @property
    def text(self) -> str:
        return " ".join("".join(self.words).split())


def plain(text: str) -> str:
    return " ".join(text.replace("`", "").split())


def test_it_says_all_that_the_document_says(service: Served) -> None:
    reply = service.ask("GET", "/docs")
    assert reply.status == 200
    assert "default-src 'none'" in reply.headers["content-security-policy"]
    found = Found(reply.content.decode())
    document = service.ask("GET", "/openapi.json").content
    for path, item in document["paths"].items():
        for method, operation in item.items():
            assert f"{method.upper()} {path}" in found.text
            for said in descriptions(operation):
                assert plain(said) in found.text
            for parameter in operation.get("parameters", []):
                assert parameter["name"] in found.text
    for name, schema in document["components"]["schemas"].items():
        assert name in found.ids
        for said in descriptions(schema):
            assert plain(said) in found.text
    assert "number, from 0 to 60000" in found.text  # X-Deadline-Ms


def descriptions(part: Any) -> list[str]:
    """What is said of an operation or schema where the page shows it: not within tensors."""
    own = [part.get(name, "") for name in ("summary", "description")]
    own += [found.get("description", "") for found in part.get("parameters", [])]
    own += [found.get("description", "") for found in part.get("responses", {}).values()]
    own += [found.get("description", "") for found in part.get("properties", {}).values()]
    return [said for said in own if said]


def test_nothing_comes_from_elsewhere_and_every_link_leads_somewhere(service: Served) -> None:
    text = service.ask("GET", "/docs").content.decode()
    found = Found(text)
    assert "script" not in found.tags
    assert "http" not in "".join(found.links)
    for link in set(found.links) - {"data:,"}:
        if link.startswith("#"):
            assert link[1:] in found.ids
        else:
            assert service.ask("GET", f"/{link.removeprefix('./')}").status == 200, link
    assert len(found.ids) == len(set(found.ids))
    assert service.ask("GET", "/redoc").status == 404


def test_what_a_document_holds_is_text() -> None:
    evil = '<script>alert("x")</script> & `<b>`'
    document = {
        "info": {"title": evil, "version": evil},
        "paths": {"/<i>": {"get": {"summary": evil, "responses": {"200": {"description": evil}}}}},
    }
    text = page(document)
    assert not {"script", "b", "i"} & Found(text).tags
    assert unescape(re.sub("</?code>", "`", text)).count(evil) == 5  # the summary twice


def test_it_needs_no_token(service: Served) -> None:
    engine = FakeEngine(lambda _image: outputs())
    with serving(engine, limits=Limits(token="0123456789abcdef")) as guarded:
        assert guarded.ask("GET", "/docs").status == 200
        assert guarded.ask("GET", "/openapi.json").status == 401


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="no chromium (Debian: apt-get install chromium)")
def test_a_browser_shows_it(service: Served, tmp_path: Path) -> None:
    shot = tmp_path / "docs.png"
    assert CHROMIUM is not None
    command = [CHROMIUM, "--headless", "--no-sandbox", "--hide-scrollbars", "--dump-dom"]
    command += ["--window-size=500,1000", f"--screenshot={shot}", f"--user-data-dir={tmp_path}"]
    done = subprocess.run([*command, f"{service.url}/docs"], capture_output=True, timeout=120)
    assert b"X-Deadline-Ms" in done.stdout
    assert shot.stat().st_size > 20_000
