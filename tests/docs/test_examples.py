"""The README and the pages in docs/: programs run, commands exist, links lead to files."""

import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path

import pytest

from docs.generate import on_page_markdown
from simulator.env import OPTIONS
from simulator.track.catalogue import read_track

ROOT = Path(__file__).parents[2]
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")])
PROGRAMS = ("simulator", "datagen", "mtlnet", "serve", "controllers")
ADDRESS = "http://127.0.0.1:8000"
# Options that make a command of the README or the tutorial small; the last one given counts.
SMALL = {
    ("datagen", "collect"): ["--rounds=4", "--frames=20", "--tracks=oval,town", "--workers=1"],
    ("mtlnet", "train"): ["--iterations", "2", "--batch", "8"],
    ("controllers", "drive"): ["--steps", "10"],
}


def blocks(page: Path, language: str) -> list[str]:
    """The fenced code blocks of a language in a page."""
    text = (
        re.sub(r"^ +", "", page.read_text(), flags=re.M) if language == "sh" else page.read_text()
    )
    return re.findall(rf"^```{language}\n(.*?)^```", text, flags=re.DOTALL | re.M)


def name(page: Path) -> str:
    return str(page.relative_to(ROOT))


def commands(text: str) -> list[list[str]]:
    """The project's own commands in a block, one a line, without comments."""
    lines = [line.split(" #")[0].split() for line in text.splitlines()]
    return [words for words in lines if words and words[0] in PROGRAMS]


def run(words: list[str], folder: Path) -> None:
    """Run a command in its smallest form; it must succeed."""
    small = SMALL.get((words[0], words[1]), [])
    subprocess.run([sys.executable, "-m", *words, *small], cwd=folder, check=True, timeout=300)


@pytest.fixture(scope="module")
def project(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Path, str]]:
    """A folder in which the README's commands were run, and the address of its service."""
    folder = tmp_path_factory.mktemp("project")
    chain = [words for text in blocks(ROOT / "README.md", "sh") for words in commands(text)]
    assert [words[:2] for words in chain] == [
        ["datagen", "collect"],
        ["mtlnet", "train"],
        ["mtlnet", "evaluate"],
        ["serve", "--model"],
        ["controllers", "drive"],
    ]
    for words in chain[:3]:
        run(words, folder)
    with subprocess.Popen(
        [sys.executable, "-m", *chain[3], "--port", "0"],
        cwd=folder,
        stderr=subprocess.PIPE,
        text=True,
    ) as service:
        try:
            assert service.stderr is not None
            first = service.stderr.readline()
            address = re.search(r"http://\S+", first)
            assert address, first + service.stderr.read()
            image = "from datagen.recording import Dataset; from pathlib import Path; "
            image += "frames = Dataset.open('datasets/default').select('all'); "
            image += "Path('image.jpg').write_bytes(bytes(frames.jpeg(0)))"
            subprocess.run([sys.executable, "-c", image], cwd=folder, check=True)
            drive = [word.replace(ADDRESS, address.group()) for word in chain[4]]
            run(drive, folder)
            yield folder, address.group()
        finally:
            service.send_signal(signal.SIGTERM)


@pytest.mark.slow
def test_the_commands_of_the_readme_run(project: tuple[Path, str]) -> None:
    folder, _ = project
    assert (folder / "datasets" / "default" / "manifest.json").is_file()
    assert (folder / "runs" / "latest" / "config.json").is_file()


# Runs programs one after the other in one process, as imports take seconds.
RUN_ALL = """
import sys
for number, program in enumerate(sys.argv[1:]):
    print(f"example {number}", flush=True)
    exec(compile(program, f"example {number}", "exec"), {"__name__": "__main__"})
"""


@pytest.mark.slow
@pytest.mark.parametrize("page", [page for page in PAGES if blocks(page, "python")], ids=name)
def test_the_python_examples_of_a_page_run(page: Path, project: tuple[Path, str]) -> None:
    folder, address = project
    programs = [
        program.replace(ADDRESS, address)
        .replace("timeout_s=0.1", "timeout_s=9")
        .replace("deadline_s=0.05", "deadline_s=8")
        .replace("[0, 500, 1000]", "[0, 5, 10]")
        for program in blocks(page, "python")
    ]
    command = [sys.executable, "-W", "error::UserWarning", "-c", RUN_ALL, *programs]
    done = subprocess.run(command, cwd=folder, check=True, timeout=600, stdout=subprocess.PIPE)
    assert done.stdout.count(b"example ") >= len(programs)
    if any("RecordVideo" in program for program in programs):
        assert list(folder.glob("videos/*.mp4"))


@pytest.mark.extended
def test_the_tutorial_runs(tmp_path: Path) -> None:
    text = (ROOT / "docs" / "tutorial.md").read_text()
    chain = re.findall(r"<!-- run -->\n```sh\n(.*?)```", text, flags=re.DOTALL)
    assert len(chain) == 4
    for block in chain:
        for words in commands(block.replace(" --minutes 1", "")):
            run(words, tmp_path)
    assert (tmp_path / "tutorial" / "report.html").is_file()


def test_the_road_of_the_page_on_own_roads_can_be_driven(tmp_path: Path) -> None:
    (text,) = blocks(ROOT / "docs/how-to/own-roads.md", "toml")
    path = tmp_path / "figure-of-eight.toml"
    path.write_text(text)
    track = read_track(path)
    lower, upper = track.at(0.0), track.at(track.length_m / 2)
    assert (float(upper.x), float(upper.y)) == pytest.approx((lower.x, lower.y), abs=2.0)
    assert float(upper.z - lower.z) > 3.0  # a bridge


def test_every_link_of_the_readme_leads_to_a_file() -> None:
    for page in ROOT.glob("*.md"):
        links = re.findall(r"\]\(([^)#]+)(?:#[^)]*)?\)", page.read_text())
        missing = [link for link in links if "://" not in link and not (ROOT / link).exists()]
        assert not missing, f"{page.name} links to {missing}"


def test_the_readme_is_short() -> None:
    lines = (ROOT / "README.md").read_text().splitlines()
    assert len(lines) <= 110
    assert [line for line in lines if len(line) > 120 and not line.startswith("|")] == []


def test_the_table_of_the_environments_names_every_option() -> None:
    text = (ROOT / "docs" / "reference" / "environments.md").read_text()
    rows = [line.split("|")[1] for line in text.splitlines() if line.startswith("| `")]
    named = set(re.findall(r"`(\w+)`", " ".join(rows)))
    options = {field.name for group in OPTIONS for field in fields(group)}
    assert named == options | {"render_mode", "max_episode_steps"}


def test_the_reference_pages_are_filled_from_the_code() -> None:
    """`make docs`, a part of `make test`, builds the pages and follows their links."""
    pages = [page for page in PAGES if "<!-- generated" in page.read_text()]
    filled = {page.stem: on_page_markdown(page.read_text()) for page in pages}
    assert sorted(filled) == ["commands", "dataset-format", "errors", "http-api", "shared-memory"]
    assert "--split-test-share" in filled["commands"]
    assert "<!-- generated" not in "".join(filled.values())
