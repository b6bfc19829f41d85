"""The service on Ray Serve: two replicas, the application builder, the console script's name."""

import os
import re
import signal
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from unittest.mock import MagicMock

import pytest
from typer.testing import CliRunner

from mtlnet.inference.engine import load_engine
from mtlnet.inference.golden_image import golden_image
from mtlnet.inference.model_card import read_card
from mtlnet.inference.prediction import decode_outputs
from runtime.sockets import bind
from serve.cameras import read_cameras
from serve.cli import app, main
from serve.config import Limits
from tests.serve.conftest import PATIENCE_S, Reply, Served, png
from tests.serve.test_cli import ROOT, command
from tests.typed import typed
from trackfeatures.errors import UserError

TOKEN = "0123456789abcdef"
REQUESTS = 40


@contextmanager
def on_ray(model: Path, token_file: Path, replicas: int) -> Iterator[int]:
    """The service on a local Ray cluster of its own; yields its port."""
    with bind("127.0.0.1", 0) as listener:
        port = listener.getsockname()[1]
    words = ("ray", "--model", str(model), "--port", str(port), "--replicas", str(replicas))
    environment = {
        **{name: value for name, value in os.environ.items() if not name.startswith("RAY_")},
        "PYTHONPATH": str(ROOT),
        "RAY_ENABLE_UV_RUN_RUNTIME_ENV": "0",
    }
    with subprocess.Popen(
        command(*words, "--token-file", str(token_file)),
        stderr=subprocess.PIPE,
        text=True,
        env=environment,
    ) as process:
        try:
            assert process.stderr is not None
            said = []
            for line in process.stderr:
                said.append(line)
                if line.startswith("serving "):
                    break
            else:
                pytest.fail("".join(said[-20:]))
            yield port
            process.send_signal(signal.SIGTERM)
            process.communicate(timeout=PATIENCE_S)
            assert process.returncode == 0
        finally:
            process.kill()


@pytest.mark.slow
@pytest.mark.extended
def test_answers_of_two_replicas_equal_the_engines(published: Path, tmp_path: Path) -> None:
    pytest.importorskip("ray.serve", reason="no ray[serve]")
    (tmp_path / "token").write_text(TOKEN)
    image = golden_image(280, 210)
    body, right = png(image[:, :, ::-1]), decode_outputs(load_engine(published)(image)).as_json()
    with on_ray(published, tmp_path / "token", replicas=2) as port:
        assert Served(port).post(body, "image/png", Authorization="Bearer wrong").status == 401
        # Ray chooses a replica for each connection.
        answers = [ask(Served(port), "POST", "/features", body) for _ in range(REQUESTS)]
        pages = [ask(Served(port), "GET", "/metrics").content for _ in range(20)]
    counts = {answered(page) for page in pages}
    for reply in answers:
        assert reply.status == 200
        assert {name: reply.content[name] for name in right} == right
        assert reply.content["model"] == read_card(published).model_hash
    # Each replica counts its own requests: both have answered, together all requests.
    assert all(0 < count < REQUESTS for count in counts)
    assert sum(counts) == (REQUESTS if len(counts) == 2 else REQUESTS // 2)


def ask(service: Served, method: str, path: str, body: bytes | None = None) -> Reply:
    headers = {"Authorization": f"Bearer {TOKEN}", "Content-Type": "image/png"}
    return service.ask(method, path, body, headers)


def answered(page: bytes) -> int:
    found = re.search(rb'frames_total{outcome="answered"} (\d+)', page)
    assert found is not None
    return int(found[1])


def test_the_builder_asks_for_the_token(
    published: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    on_ray_module = pytest.importorskip("serve.on_ray", reason="no ray[serve]")
    bound: list[Limits] = []
    monkeypatch.setattr(on_ray_module, "_bind", lambda config: bound.append(config.limits))
    model = {"model": str(published)}
    on_ray_module.build(model)
    monkeypatch.setenv("DRIVERVIEW_TOKEN", TOKEN)
    on_ray_module.build({**model, "hosts": ["cam.example"]})
    (tmp_path / "token").write_text(TOKEN[::-1])
    on_ray_module.build({**model, "token_file": str(tmp_path / "token")})
    assert [limits.token for limits in bound] == [None, TOKEN, TOKEN[::-1]]
    assert bound[1].hosts == ("cam.example",)
    on_ray_module.build({**model, "hosts": "cam.example", "replicas": "2"})
    assert bound.pop().hosts == ("cam.example",)
    monkeypatch.setenv("DRIVERVIEW_TOKEN", "short")
    with pytest.raises(UserError, match="must be 16 or more"):
        on_ray_module.build(model)


def test_cameras_and_views_reach_the_replicas(
    published: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    on_ray_module = pytest.importorskip("serve.on_ray", reason="no ray[serve]")
    deployed: list[Any] = []

    def take(application: Any) -> MagicMock:
        deployed.append(application)
        return MagicMock()

    monkeypatch.setattr(on_ray_module.ray_serve, "ingress", take)
    monkeypatch.setattr(on_ray_module.ray_serve, "deployment", lambda **_: MagicMock())
    monkeypatch.delenv("DRIVERVIEW_TOKEN", raising=False)
    roof = tmp_path / "roof.yaml"
    roof.write_text("width: 280\nheight: 210\nfov_y_deg: 67.5\nyaw_deg: 2\n")
    model, cameras = ["--model", str(published)], [f"roof={roof}"]
    monkeypatch.setattr(on_ray_module, "run", on_ray_module._bind)
    words = ["ray", *model, "--camera", cameras[0], "--views", "2"]
    assert CliRunner().invoke(app, words).exit_code == 0
    on_ray_module.build({"model": str(published), "cameras": cameras, "views": "2"})
    for application in deployed:
        loaded = application().frame_queue.loaded
        assert loaded.cameras == read_cameras(cameras, loaded.view)
        assert loaded.engine.views.count == 2
    for wrong, said in (({"views": 3}, "give 1, 2 or 6"), ({"cameras": "roof"}, "give NAME=FILE")):
        with pytest.raises(UserError, match=said):
            on_ray_module.build({"model": str(published), **wrong})


def test_the_builder_refuses_unknown_options(published: Path) -> None:
    on_ray_module = pytest.importorskip("serve.on_ray", reason="no ray[serve]")
    assert on_ray_module.build({"model": str(published), "replicas": 2}) is not None
    with pytest.raises(UserError, match="unknown argument speed"):
        on_ray_module.build({"speed": 9})
    with pytest.raises(UserError, match="no run"):
        on_ray_module.build({"model": "/none"})
    for wrong in (0, -1, 1.5, "two", None):
        with pytest.raises(UserError, match="replicas is"):
            on_ray_module.build({"model": str(published), "replicas": wrong})


@pytest.mark.parametrize("address", [None, "ray.example:6379"])
def test_only_a_cluster_that_is_named_is_joined(
    published: Path, monkeypatch: pytest.MonkeyPatch, address: str | None
) -> None:
    ray = pytest.importorskip("ray")
    on_ray = pytest.importorskip("serve.on_ray")
    asked: list[str] = []

    def init(*, address: str, **_: object) -> None:
        asked.append(address)
        raise ConnectionError("no answer")

    monkeypatch.setattr(ray, "init", init)
    monkeypatch.delenv("RAY_ADDRESS", raising=False)
    if address is not None:
        monkeypatch.setenv("RAY_ADDRESS", address)
    config = on_ray.RayConfig(model=str(published))
    with pytest.raises(UserError, match="no Ray cluster could be joined or started"):
        on_ray.run(config)
    assert asked == [address or "local"]


def test_error_without_ray_serve_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "serve.on_ray", None)
    done = typed("serve", "ray")
    assert done.returncode == 1
    assert "driverview[rayserve]" in done.stderr
    assert done.stderr.count("\n") == 1
    assert "set a token" in typed("serve", "ray", "--host", "0.0.0.0").stderr


def test_driverview_serve_stays_available_beside_rays_serve() -> None:
    """Ray also installs a console script `serve`; the package installed last owns this name."""
    scripts = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]
    assert scripts["driverview-serve"] == scripts["serve"] == f"{main.__module__}:{main.__name__}"
