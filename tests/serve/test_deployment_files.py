"""The Dockerfile and the manifests match the service: ports, paths, users, options."""

import re
import tomllib
from importlib.metadata import PackageNotFoundError, requires
from pathlib import Path
from typing import Any

import pytest
import yaml
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from typer.testing import CliRunner

from serve.cli import app
from tests.serve.conftest import Served

ROOT = Path(__file__).parents[2]
DEPLOY = ROOT / "deploy"
DOCKERFILE = (ROOT / "Dockerfile").read_text()


def manifest(name: str) -> dict[str, Any]:
    content = yaml.safe_load((DEPLOY / "kubernetes" / name).read_text())
    assert isinstance(content, dict)
    return content


@pytest.fixture(scope="module")
def pod() -> dict[str, Any]:
    spec = manifest("deployment.yaml")["spec"]["template"]["spec"]
    assert isinstance(spec, dict)
    return spec


@pytest.fixture(scope="module")
def container(pod: dict[str, Any]) -> dict[str, Any]:
    (container,) = pod["containers"]
    assert isinstance(container, dict)
    return container


def test_probe_paths_are_answered_by_the_service(
    service: Served, container: dict[str, Any]
) -> None:
    for probe in ("startupProbe", "readinessProbe", "livenessProbe"):
        assert service.ask("GET", container[probe]["httpGet"]["path"]).status == 200
        assert container[probe]["httpGet"]["port"] == container["ports"][0]["name"]


def test_pod_is_unprivileged_and_uses_the_images_user(
    pod: dict[str, Any], container: dict[str, Any]
) -> None:
    users = re.findall(r"--uid (\d+)", DOCKERFILE)
    assert pod["securityContext"]["runAsUser"] == int(users[0])
    assert pod["securityContext"]["runAsNonRoot"]
    security = container["securityContext"]
    assert security["readOnlyRootFilesystem"]
    assert not security["allowPrivilegeEscalation"]
    assert security["capabilities"]["drop"] == ["ALL"]
    assert container["resources"]["limits"]["cpu"] == "1"
    assert "token" not in str(container.get("args"))


def test_ports_of_image_and_manifests_agree() -> None:
    exposed = re.findall(r"^EXPOSE (\d+)$", DOCKERFILE, flags=re.MULTILINE)
    assert exposed == ["8000"]
    (container,) = manifest("deployment.yaml")["spec"]["template"]["spec"]["containers"]
    assert container["ports"][0]["containerPort"] == 8000
    assert manifest("service.yaml")["spec"]["ports"][0]["targetPort"] == "http"
    compose = yaml.safe_load((DEPLOY / "compose.yaml").read_text())
    assert compose["services"]["serve"]["ports"] == ["127.0.0.1:8000:8000"]
    scraped = yaml.safe_load((DEPLOY / "prometheus.yml").read_text())["scrape_configs"][0]
    assert scraped["static_configs"][0]["targets"] == ["serve:8000"]


def test_every_passed_option_exists(container: dict[str, Any]) -> None:
    shown = CliRunner().invoke(app, ["--help"], env={"COLUMNS": "200"}).output
    compose = yaml.safe_load((DEPLOY / "compose.yaml").read_text())["services"]
    image = re.findall(r'^CMD (\["serve".*\])$', DOCKERFILE, flags=re.MULTILINE)
    commands = [container["args"], compose["serve"]["command"], *map(yaml.safe_load, image)]
    assert len(commands) == 3
    for command in commands:
        assert command[0] == "serve"
        for option in (word for word in command if word.startswith("--")):
            assert re.search(rf"{option}\b", shown), option


def test_the_shipped_model_is_served_without_a_mounted_folder(
    pod: dict[str, Any], container: dict[str, Any]
) -> None:
    compose = yaml.safe_load((DEPLOY / "compose.yaml").read_text())["services"]["serve"]
    for command in (container["args"], compose["command"]):
        assert command[command.index("--model") + 1] == "default"
    assert "volumes" not in compose
    assert [volume["name"] for volume in pod["volumes"]] == ["scratch"]


def test_references_between_manifests_resolve() -> None:
    files = manifest("kustomization.yaml")["resources"]
    assert {path.name for path in (DEPLOY / "kubernetes").iterdir()} == {
        *files,
        "kustomization.yaml",
    }
    deployment = manifest("deployment.yaml")
    labels = deployment["spec"]["template"]["metadata"]["labels"]
    assert manifest("service.yaml")["spec"]["selector"].items() <= labels.items()
    assert manifest("disruption.yaml")["spec"]["selector"]["matchLabels"] == labels
    scaled = manifest("autoscaler.yaml")["spec"]["scaleTargetRef"]
    assert (scaled["kind"], scaled["name"]) == ("Deployment", deployment["metadata"]["name"])
    named = manifest("kustomization.yaml")["images"][0]["name"]
    assert deployment["spec"]["template"]["spec"]["containers"][0]["image"] == named


def test_images_have_the_projects_version_as_tag_everywhere() -> None:
    """`kubectl apply -k` uses the image that the documented commands build."""
    version = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    (image,) = manifest("kustomization.yaml")["images"]
    assert image == {"name": "driverview-serve", "newTag": version}
    named = re.compile(r"\bdriverview-(?:serve|train|collect|TARGET)\b(?![`=])(\S*)")
    names = 0
    for path in (ROOT / "Dockerfile", DEPLOY / "compose.yaml", ROOT / "docs/how-to/deploy.md"):
        tags = named.findall(path.read_text())
        assert {tag.rstrip("`.,") for tag in tags} == {f":{version}"}, path
        names += len(tags)
    assert names >= 6


def test_serving_image_has_neither_torch_nor_simulator() -> None:
    stage = DOCKERFILE.split("FROM base AS serve")[1]
    assert "[" not in stage.split("pip install")[1].split("\n")[0].replace(
        "$(ls /wheels/*.whl)", ""
    )
    assert "USER driverview" in stage
    assert "HEALTHCHECK" in stage


def test_images_get_every_package_and_only_files_of_known_hashes() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    packages = [n.rstrip("*") for n in project["tool"]["setuptools"]["packages"]["find"]["include"]]
    sent = (ROOT / ".dockerignore").read_text().splitlines()
    for package in packages:
        assert f"COPY {package} {package}\n" in DOCKERFILE
        assert f"!{package}" in sent
    for path in re.findall(r"^COPY (?!--)(.+) \S+$", DOCKERFILE, flags=re.MULTILINE):
        assert all(f"!{name}" in sent for name in path.split()), path
    for name in ("requirements.lock", "deploy/uv.txt"):
        pins = re.split(r"^(?=\S)", (ROOT / name).read_text(), flags=re.MULTILINE)[1:]
        assert pins
        assert all(
            re.match(r"\S+==\S+( ; .+)? \\\n +--hash=sha256:[0-9a-f]{64}", pin) for pin in pins
        )
    assert DOCKERFILE.count("pip install") == DOCKERFILE.count("/wheels/requirements.lock") + 2
    assert "--require-hashes --requirement build.txt" in DOCKERFILE
    assert "pip wheel --no-cache-dir --no-deps --no-build-isolation" in DOCKERFILE
    assert "--require-hashes --requirement /wheels/uv.txt" in DOCKERFILE
    assert not re.findall(r"^FROM (?!\$\{PYTHON_IMAGE\}|base)", DOCKERFILE, flags=re.MULTILINE)


def test_images_of_others_are_pinned_by_digest() -> None:
    services = yaml.safe_load((DEPLOY / "compose.yaml").read_text())["services"]
    (base,) = re.findall(r"^ARG PYTHON_IMAGE=(.+)$", DOCKERFILE, flags=re.MULTILINE)
    images = [base, *(found["image"] for found in services.values() if "build" not in found)]
    assert len(images) == 2
    for image in images:
        assert re.search(r"[\w/]+:[\w.-]+@sha256:[0-9a-f]{64}\b", image), image


def test_compose_bounds_memory_and_processes() -> None:
    services = yaml.safe_load((DEPLOY / "compose.yaml").read_text())["services"]
    for service in services.values():
        assert service["mem_limit"]
        assert service["pids_limit"] <= 256
        assert service["cap_drop"] == ["ALL"]
    assert services["serve"]["read_only"]


def test_the_lock_holds_every_dependency_of_every_package_in_it() -> None:
    """With hashes, pip refuses to install a dependency that has no line in the lock file."""
    lock = (ROOT / "requirements.lock").read_text()
    locked = {canonicalize_name(name) for name in re.findall(r"^([\w.-]+)==", lock, re.MULTILINE)}
    missing = []
    for package in sorted(locked):
        try:
            needed = [Requirement(line) for line in requires(package) or []]
        except PackageNotFoundError:
            continue  # a package for another platform
        missing += [
            f"{package} needs {requirement}"
            for requirement in needed
            if requirement.marker is None or requirement.marker.evaluate({"extra": ""})
            if canonicalize_name(requirement.name) not in locked
        ]
    assert len(locked) > 100
    assert not missing


def test_an_example_that_mounts_runs_serves_one_of_them() -> None:
    """Without `--model` the container serves the shipped model."""
    examples = re.findall(r"docker run(?:.*\\\n)*.*", DOCKERFILE)
    serving = [example for example in examples if "driverview-serve" in example]
    assert serving
    for example in serving:
        assert "/driverview/runs" not in example or " serve --model " in example
