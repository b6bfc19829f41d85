"""The page at /docs: Swagger UI with the complete OpenAPI document, without external requests."""

import json
import re
from pathlib import Path

import pytest
from fastapi import FastAPI

from serve.api.console import docs_page
from serve.config import Limits
from tests.browser import CHROMIUM, MISSING, open_browser
from tests.serve.conftest import Served, serving


def embedded_document(page: str) -> object:
    found = re.search(r'<script type="application/json" id="openapi">(.*?)</script>', page, re.S)
    assert found
    return json.loads(found[1])


def test_the_page_contains_the_openapi_document(service: Served) -> None:
    reply = service.ask("GET", "/docs")
    assert reply.status == 200
    document = service.ask("GET", "/openapi.json").content
    assert embedded_document(reply.content.decode()) == document


def test_every_file_is_served_locally_with_a_strict_csp(service: Served) -> None:
    page = service.ask("GET", "/docs")
    policy = page.headers["content-security-policy"]
    assert "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'" in policy
    assert "unsafe" not in policy
    markup = page.content.decode().replace(json.dumps(embedded_document(page.content.decode())), "")
    links = re.findall(r'(?:href|src)="([^"]+)"', markup)
    assert {"console/swagger-ui-bundle.js", "console/swagger-ui.css"} < set(links)
    for link in set(links) - {"data:,"}:
        reply = service.ask("GET", f"/{link}")
        assert reply.status == 200, link
        assert reply.headers["content-security-policy"] == policy
    assert service.ask("GET", "/redoc").status == 404
    assert service.ask("GET", "/console/docs.html").status == 404  # only available as /docs


def test_document_text_cannot_close_the_script_element() -> None:
    app = FastAPI(title="</script><script>alert(1)</script>")
    page = docs_page(app)
    assert page.count("</script>") == 3
    document = embedded_document(page)
    assert isinstance(document, dict)
    assert document["info"]["title"] == app.title


def test_the_page_needs_no_token_and_offers_to_enter_one(service: Served) -> None:
    with serving(limits=Limits(token="0123456789abcdef")) as guarded:
        reply = guarded.ask("GET", "/docs")
        assert reply.status == 200
        assert guarded.ask("GET", "/openapi.json").status == 401
    document = embedded_document(reply.content.decode())
    assert isinstance(document, dict)
    assert document["components"]["securitySchemes"]["token"]["scheme"] == "bearer"
    assert document["paths"]["/features"]["post"]["security"] == [{"token": []}]
    assert "security" not in document["paths"]["/readyz"]["get"]
    assert "securitySchemes" not in service.ask("GET", "/openapi.json").content["components"]


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason=MISSING)
def test_a_browser_renders_every_operation(service: Served, tmp_path: Path) -> None:
    paths = service.ask("GET", "/openapi.json").content["paths"]
    with open_browser(tmp_path, 1280, 900) as browser:
        browser.open(f"{service.url}/docs")
        shown = "[...document.querySelectorAll('[data-path]')].map((e) => e.dataset.path)"
        browser.wait(f"new Set({shown}).size >= {len(paths)}")
        assert set(browser.evaluate(shown)) == set(paths)
