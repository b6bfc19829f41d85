"""The commands that are disturbed: what lies in their folder before, and what its readers take."""

import json
import shutil
import tarfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import trackfeatures as tf
from datagen.recording import Dataset
from datagen.recording.folder import prepare, read_states, round_path
from datagen.recording.integrity.round_checks import check_round
from datagen.recording.integrity.verify import verify
from datagen.recording.splits import Split, read_split, split_path, write_split
from mtlnet.inference.engine import load_engine, openvino_core, read_export, run_graph
from mtlnet.inference.golden_image import golden_image
from mtlnet.inference.model_card import GRAPH, MODEL_FILES, ModelError, check_files, read_card
from runtime.files import file_hash
from tests.chaos.process import Runner
from tests.datagen.conftest import Samples
from tests.mtlnet.conftest import TEST, TRAIN, write_round
from trackfeatures.errors import UserError

ROUNDS = {"r000": "train", "r001": "train", "r002": "test", "r003": "test"}
IMAGE = golden_image(280, 210)
RUN = "--recipe paper --batch 2 --device cpu --threads 1"
UNFINISHED = (".partial", "staged", ".merging")
"""Parts of the names of files that are not complete."""


@dataclass(frozen=True)
class Case:
    """A command; `home` is the folder that it changes, `material` holds what it reads."""

    name: str
    prepare: Callable[[Path, Path], object]
    """Makes the old state, from (material, home)."""
    words: str
    """The command, with the places {material} and {home}."""
    look: Callable[[Path], Any]
    """What a reader takes as whole; None: it refuses. Fails where a part is taken as whole."""
    share: int = 1
    """One in so many kills: loading a model takes longer."""
    by_round: bool = False
    """Each round counts: a dataset of old rounds and some of the new ones is whole as well."""

    def command(self, material: Path, home: Path) -> list[str]:
        """The command, or what continues a training that has its configuration."""
        if self.words == TRAIN_WORDS and (home / "run" / "config.json").is_file():
            return ["mtlnet", "train", "--out", str(home / "run"), "--resume"]
        return self.words.format(material=material, home=home).split()


def make_material(folder: Path, runner: Runner) -> None:
    """Shards, damaged rounds, a dataset and two models."""
    samples = Samples()
    for name, ids in {"one": ("r000", "r002"), "two": ("r001", "r003")}.items():
        prepare(folder / name)
        _write_plan(folder / name)
        for round_id in ids:
            samples.add_round(folder / name, samples.header(round_id))
    for name, shards in {"first": ["one"], "both": ["one", "two"]}.items():
        parts = [str(folder / shard) for shard in shards]
        words = ["datagen", "merge", *parts, "--out", str(folder / name)]
        assert runner.run(words, folder).code == 0
    damaged = bytearray(round_path(folder / "both", "r001").read_bytes())
    damaged[len(damaged) // 2] ^= 255
    (folder / "r001.mcap").write_bytes(damaged)
    (folder / "roads" / "rounds").mkdir(parents=True)
    (folder / "roads" / "splits").mkdir()
    for number, name in enumerate(TRAIN + TEST):
        write_round(folder / "roads", name, number)
    write_split(split_path(folder / "roads"), Split(TRAIN, TEST))
    for name, seed in (("model", "3"), ("other", "2")):
        words = ["mtlnet", "train", "--data", str(folder / "roads"), "--out", str(folder / name)]
        done = runner.run([*words, *RUN.split(), "--iterations", "2", "--seed", seed], folder)
        assert done.code == 0, done.stderr


def _write_plan(folder: Path) -> None:
    entries = [{"id": name, "split": side} for name, side in ROUNDS.items()]
    plan = {"hash": "0" * 64, "definitions": tf.VERSION, "rounds": entries}
    (folder / "plan.json").write_text(json.dumps(plan))


# Datasets


def look_at_dataset(home: Path) -> Any:
    """The rounds that training sees; what `datagen verify` finds in order is complete."""
    try:
        dataset = Dataset.open(home / "out")
    except UserError:
        assert not verify(home / "out", "full").ok
        return None
    sides = {info.id: info.split for info in dataset.rounds}
    assert sides == {name: ROUNDS[name] for name in sides}
    states = read_states(home / "out")
    for info in dataset.rounds:
        assert check_round(info.path, "full", states[info.id])[1] == []
    return tuple(sorted(sides)), dataset.content_hash


def look_at_recovered(home: Path) -> Any:
    """The hash of the recovered round."""
    path, states = round_path(home / "data", "r001"), read_states(home / "data")
    if not path.is_file():
        return None
    assert check_round(path, "full", states["r001"])[1] == []
    return states["r001"].sha256


def look_at_file(home: Path) -> Any:
    """The hash of a round that was recovered into a file of its own."""
    path = home / "saved.mcap"
    if not path.is_file():
        return None
    assert check_round(path, "full", None)[1] == [f"{path.name}: no state file holds its hashes"]
    return file_hash(path)


def look_at_split(home: Path) -> Any:
    """The split, once it is there."""
    path = split_path(home / "data", "mine")
    return read_split(path) if path.is_file() else None


def look_at_shards(home: Path) -> Any:
    """The frames of an export, once it is there."""
    if not (home / "out").is_dir():
        return None
    found = []
    for path in sorted((home / "out").glob("*.tar")):
        with tarfile.open(path) as shard:
            found.append((path.name, [(member.name, member.size) for member in shard]))
    return found, (home / "out" / "README.md").read_text()


def _prepare_recovery(material: Path, home: Path) -> None:
    """A dataset whose damaged round was moved out of it, and a split of its own."""
    shutil.copytree(material / "both", home / "data")
    round_path(home / "data", "r001").unlink()


# Models


def look_at_run(home: Path) -> Any:
    """What the service would load, and its answer."""
    run = home / "run"
    try:
        card = read_card(run)
        check_files(run, card, MODEL_FILES)
        engine = load_engine(run, precision="f32")
    except ModelError:
        return None
    return card.files, card.iterations, engine(IMAGE).tolist()


def look_at_export(home: Path) -> Any:
    """The files of an export as its `export.json` has them, and the answer of the graph."""
    about = read_export(home / "out")
    if about is None:
        return None
    for name, expected in about["files"].items():
        assert file_hash(home / "out" / name) == expected
    graph = openvino_core().read_model(str(home / "out" / GRAPH))
    return about["files"], about["model_hash"], run_graph(graph, "f32", IMAGE[None]).tolist()


def look_at_report(home: Path) -> Any:
    """The page."""
    return (home / "page.html").read_text()


TRAIN_WORDS = "mtlnet train --out {home}/run --iterations 3 --data {material}/roads " + RUN


def copied(source: str, target: str) -> Callable[[Path, Path], object]:
    """Makes the old state: a folder of the material in the home."""
    return lambda material, home: shutil.copytree(material / source, home / target)


CASES = (
    Case(
        "merge",
        lambda *_: None,
        "datagen merge {material}/one {material}/two --out {home}/out",
        look_at_dataset,
        by_round=True,
    ),
    Case(
        "merge into a dataset",
        copied("first", "out"),
        "datagen merge {material}/two --out {home}/out",
        look_at_dataset,
        by_round=True,
    ),
    Case(
        "recover",
        lambda *_: None,
        "datagen recover {material}/r001.mcap --out {home}/saved.mcap",
        look_at_file,
    ),
    Case(
        "recover into a dataset",
        _prepare_recovery,
        "datagen recover {material}/r001.mcap --out {home}/data/rounds/r001.mcap",
        look_at_recovered,
    ),
    Case(
        "split",
        copied("both", "data"),
        "datagen split {home}/data --name mine --by round",
        look_at_split,
    ),
    Case(
        "export a dataset",
        lambda *_: None,
        "datagen export {material}/both --out {home}/out",
        look_at_shards,
        share=4,
    ),
    Case("train", lambda *_: None, TRAIN_WORDS, look_at_run, share=4),
    Case(
        "train on",
        copied("model", "run"),
        "mtlnet train --out {home}/run --resume --iterations 4",
        look_at_run,
        share=4,
    ),
    Case(
        "export",
        copied("other/export/openvino-f32", "out"),
        "mtlnet export --model {material}/model --frames 2 --data {material}/roads"
        " --out {home}/out",
        look_at_export,
        share=4,
    ),
    Case(
        "evaluate",
        lambda _material, home: (home / "page.html").write_text("old"),
        "mtlnet evaluate --model {material}/model --split test --data {material}/roads"
        " --report {home}/page.html",
        look_at_report,
        share=4,
    ),
)
