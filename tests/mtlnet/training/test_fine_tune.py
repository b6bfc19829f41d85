"""Fine-tuning starts with the model's outputs, keeps its camera, and trains on custom images."""

import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from datagen.recording import Dataset
from mtlnet.architecture import GRID
from mtlnet.evaluation.evaluate import evaluate
from mtlnet.inference.engine import load_engine
from mtlnet.inference.model_card import WEIGHTS, read_card
from mtlnet.inference.prediction import decode_outputs, split_outputs
from mtlnet.model.network import Network, initialise, load_network, predict_images
from mtlnet.model.pretrained import load_pretrained
from mtlnet.train import start_training
from mtlnet.training.config import TrainConfig
from mtlnet.training.configure import open_pretrained, resume_config
from mtlnet.training.device import subnormals_as_zero
from mtlnet.training.sources import continue_from_model, custom_training_data, open_training_data
from trackfeatures.camera import CameraParameters
from trackfeatures.errors import UserError

pytestmark = pytest.mark.usefixtures("short_fit", "no_graph")


@pytest.fixture
def custom_images(dataset: Path, tmp_path: Path) -> Path:
    """Six frames of the dataset as a user's own images, twice as large."""
    folder = tmp_path / "mine"
    folder.mkdir()
    frames = Dataset.open(dataset).select("train")
    lines = ["file,ml,mr,l,m,r,angle,heading"]
    for i in range(6):
        large = cv2.resize(frames.image(i)[..., ::-1], (560, 420))
        cv2.imwrite(str(folder / f"{i}.png"), large)
        lines.append(f"{i}.png,-1.{i},2.{9 - i},,,,{0.01 * i},straight")
    (folder / "labels.csv").write_text("\n".join(lines) + "\n")
    return folder


def test_fine_tuning_starts_with_the_outputs_of_the_model(published: Path) -> None:
    network = Network()
    network.target_mean.copy_(torch.linspace(0.2, 0.7, 6))
    network.target_std.copy_(torch.linspace(0.02, 0.3, 6))
    load_pretrained(network, published / WEIGHTS)
    frames = np.random.default_rng(0).integers(0, 256, (2, 210, 280, 3), dtype=np.uint8)
    expected = predict_images(load_network(published / WEIGHTS), frames)
    np.testing.assert_allclose(predict_images(network, frames), expected, atol=1e-5)


def test_fine_tuning_a_network_with_bins_starts_with_its_outputs(tmp_path: Path) -> None:
    trained = Network(architecture=GRID)
    initialise(trained, 3)
    save_file(trained.state_dict(), tmp_path / WEIGHTS)
    network = Network(architecture=GRID)
    network.target_std.copy_(torch.linspace(0.02, 0.3, 6))  # set from the images, not used
    load_pretrained(network, tmp_path / WEIGHTS)
    frames = np.random.default_rng(0).integers(0, 256, (2, 210, 280, 3), dtype=np.uint8)
    expected = predict_images(trained.eval(), frames)
    np.testing.assert_allclose(predict_images(network, frames), expected, atol=1e-5)


def test_fine_tuning_on_custom_images_lowers_their_error(
    published: Path, custom_images: Path, tmp_path: Path
) -> None:
    options = {"data": custom_images, "init": str(published), "iterations": 30, "batch": 4}
    options.update(device="cpu", threads=1)
    start_training(options, tmp_path / "run", resume=False)
    before, card = read_card(published), read_card(tmp_path / "run")
    assert (card.recipe, card.network, card.camera) == ("tune", before.network, before.camera)
    assert card.data["init"] == {"name": before.name, "model_hash": before.model_hash}
    assert card.data["frames"] == 6
    assert card.data["mean"]["distances_m"][:2] == pytest.approx([-1.25, 2.65])
    material = custom_training_data(custom_images, before.camera)
    images = material.frames.read_batch(np.arange(6))
    errors = []
    for run in (published, tmp_path / "run"):
        coded = predict_images(load_network(run / WEIGHTS), images)[:, :2]
        target = 0.1 + 0.8 * (np.array([[-1.25, 2.65]]) - [-5.5, 0.5]) / 5
        errors.append(np.abs(coded - target).mean())
    assert errors[1] < 0.8 * errors[0]


def test_a_model_is_trained_on_with_batch_normalisation(
    published: Path, dataset: Path, tmp_path: Path
) -> None:
    options = {"data": dataset, "init": str(published), "recipe": "continue", "batch": 8}
    options.update(iterations=12, device="cpu", threads=1)
    start_training(options, tmp_path / "run", resume=False)
    before, card = read_card(published), read_card(tmp_path / "run")
    assert (card.recipe, card.network, card.iterations) == ("continue", before.network, 12)
    assert card.data["init"]["model_hash"] == before.model_hash
    old, new = (load_network(run / WEIGHTS).state_dict() for run in (published, tmp_path / "run"))
    # The first convolution stays, apart from the folded batch statistics.
    changed = {name for name in old if not torch.equal(old[name], new[name])}
    assert "features.conv2.layer.weight" in changed
    slopes = new["features.conv0.layer.weight"].flatten(1) / old[
        "features.conv0.layer.weight"
    ].flatten(1)
    assert float((slopes.std(1) / slopes.mean(1).abs()).median()) < 1e-3


def test_images_of_another_camera_are_evaluated_and_trained_on(
    published: Path, custom_images: Path, dataset: Path, tmp_path: Path
) -> None:
    engine = load_engine(published, "torch")
    plain = evaluate([engine], custom_images, "all")
    assert (plain["frames"], plain["rounds"], plain["split"]) == (6, 0, "all")
    assert plain["mae_m"]["ml"] > 0
    assert plain["mae_m"]["l"] is None
    assert "by_track" not in plain
    (custom_images / "camera.yaml").write_text("x: 0.75\n")  # the model's own
    same = evaluate([engine], custom_images, "all")
    assert same["mae_m"]["ml"] == pytest.approx(plain["mae_m"]["ml"], abs=1e-4)
    assert same["angle_mae_rad"] == pytest.approx(plain["angle_mae_rad"], abs=1e-6)
    (custom_images / "camera.yaml").write_text("height_above_road_m: 1.5\n")
    higher = evaluate([engine], custom_images, "all", every=2)
    assert higher["frames"] == 3
    assert higher["mae_m"]["ml"] != plain["mae_m"]["ml"]
    copies = evaluate(
        [engine], custom_images, "all", copies="mirrored,turned", page=tmp_path / "page.html"
    )
    assert copies["frames"] == copies["pictures"]["cases"] == 24
    assert (tmp_path / "page.html").read_text().count("<figure>") == 24
    with pytest.raises(UserError, match="--worst shows recorded rounds; --report shows all"):
        evaluate([engine], custom_images, "all", worst=tmp_path / "worst.jpg")
    with pytest.raises(UserError, match=r"--copies is for pictures with a labels\.csv"):
        evaluate([engine], dataset, "all", copies="mirrored")
    card = read_card(published)
    frames = custom_training_data(custom_images, card.camera).frames
    assert frames.labels.distances[0, 0] == pytest.approx(-1.0 * 1.2 / 1.5, abs=1e-3)


def write_drives(folder: Path, drives: list[str]) -> None:
    """Write a `labels.csv` with six pictures, which belong to the drives in turn."""
    lines = ["file,ml,mr,l,m,r,angle,heading,drive"]
    for i in range(6):
        lines.append(f'{i}.png,-1.{i},2.{9 - i},?,?,?,0.01,?,"{drives[i % len(drives)]}"')
    (folder / "labels.csv").write_text("\n".join(lines) + "\n")


def test_unknown_labels_are_trained_on_and_whole_drives_left_out(
    published: Path, custom_images: Path, tmp_path: Path
) -> None:
    write_drives(custom_images, ["drive 0", "drive 1", "drive 2"])
    options = {"data": custom_images, "init": str(published), "iterations": 12, "batch": 4}
    options.update(device="cpu", threads=1, hold_out_drives="drive 1, drive 0")
    start_training(options, tmp_path / "run", resume=False)
    card = read_card(tmp_path / "run")
    assert (card.data["frames"], card.data["held_out_drives"]) == (2, ["drive 1", "drive 0"])
    assert len(card.data["pictures"]) == 2
    weights = load_network(tmp_path / "run" / WEIGHTS).state_dict()
    assert all(bool(torch.isfinite(value).all()) for value in weights.values())
    found = evaluate([load_engine(tmp_path / "run", "torch")], custom_images, "all")
    assert found["heading_accuracy"] is None
    seen = found["pictures"]["by_training"]
    assert {name: part["cases"] for name, part in seen.items()} == {
        "not trained on": 4,
        "trained on": 2,
    }
    with pytest.raises(UserError, match=r"--hold-out-drives has 'x'; the drives in .* 'drive 0', "):
        custom_training_data(custom_images, read_card(published).camera, "drive 0,x")
    with pytest.raises(UserError, match="names all drives"):
        custom_training_data(custom_images, read_card(published).camera, "drive 0,drive 1,drive 2")


@pytest.mark.parametrize(
    ("given", "held_out"),
    [
        ("Berlin, night", ["Berlin, night"]),
        ("Berlin", ["Berlin"]),
        ("Rome ,Berlin, night,Berlin,", ["Rome", "Berlin, night", "Berlin"]),
    ],
)
def test_a_drive_is_held_out_by_a_name_with_commas(
    published: Path, custom_images: Path, given: str, held_out: list[str]
) -> None:
    write_drives(custom_images, ["Berlin, night", "Berlin", "Rome", "Oslo"])
    data = custom_training_data(custom_images, read_card(published).camera, given)
    assert data.about["held_out_drives"] == held_out
    kept = {picture.drive for picture in data.frames.pictures}  # type: ignore[union-attr]
    assert kept == {"Berlin, night", "Berlin", "Rome", "Oslo"} - set(held_out)


def test_held_out_drives_are_not_converted_and_the_mean_label_is_in_metres_of_the_pictures(
    published: Path, custom_images: Path
) -> None:
    """The camera is 1.4 m high, the model's 1.2 m: at the model's camera `ml` of the second drive
    would be -0.47 m, which the coding cannot express."""
    (custom_images / "camera.yaml").write_text("height_above_road_m: 1.4\n")
    rows = ["0.png,-1.75,1.75,,,,0,straight,a", "1.png,-0.55,2.95,?,?,?,0,straight,b"]
    header = "file,ml,mr,l,m,r,angle,heading,drive"
    (custom_images / "labels.csv").write_text("\n".join([header, *rows]) + "\n")
    data = custom_training_data(custom_images, read_card(published).camera, "b")
    assert data.about["mean"]["distances_m"][:2] == pytest.approx([-1.75, 1.75])
    assert data.frames.labels.distances[0, :2] == pytest.approx([-1.5, 1.5], abs=1e-3)


def test_a_run_with_drives_held_out_continues_on_other_data(
    published: Path, custom_images: Path, dataset: Path, tmp_path: Path
) -> None:
    write_drives(custom_images, ["a", "b"])
    run = tmp_path / "run"
    options = {"data": custom_images, "init": str(published), "iterations": 1, "batch": 4}
    options.update(device="cpu", threads=1, hold_out_drives="b")
    start_training(options, run, resume=False)
    same = {"data": custom_images, "change_data": True}
    assert resume_config(run, same)[0].hold_out_drives == "b"  # more pictures in the same folder
    assert resume_config(run, {**same, "hold_out_drives": "a"})[0].hold_out_drives == "a"
    with pytest.raises(UserError, match="started with hold_out_drives b, now a is given"):
        resume_config(run, {"hold_out_drives": "a"})
    rounds = {"data": dataset, "change_data": True, "iterations": 2, "skip_undecodable": True}
    start_training(rounds, run, resume=True)
    card = read_card(run)
    assert [data["path"] for data in card.data["earlier"]][-1] == str(custom_images)
    resumed, _ = resume_config(run, {})
    assert (resumed.data, resumed.hold_out_drives, resumed.skip_undecodable) == (dataset, "", True)


def test_a_run_on_custom_images_is_resumed_though_its_model_is_gone(
    published: Path, custom_images: Path, tmp_path: Path
) -> None:
    """The images are rectified to the camera that the run has stored."""
    camera, model, run = CameraParameters(z=1.3), tmp_path / "model", tmp_path / "run"
    shutil.copytree(published, model)
    replace(read_card(model), camera=camera).write(model)
    options = {"data": custom_images, "init": str(model), "iterations": 1, "batch": 4}
    start_training({**options, "device": "cpu", "threads": 1}, run, resume=False)
    shutil.rmtree(model)
    start_training({"iterations": 2}, run, resume=True)
    card = read_card(run)
    assert (card.iterations, card.camera) == (2, camera)


def test_wrong_options_are_refused(
    published: Path, custom_images: Path, dataset: Path, tmp_path: Path
) -> None:
    with pytest.raises(UserError, match="give the model to fine-tune with --init"):
        custom_training_data(custom_images, None)
    options = {"data": custom_images, "init": str(published), "network": "deepdriving"}
    with pytest.raises(UserError, match="--init is a mtl, not a deepdriving"):
        start_training({**options, "alpha": (1.0, 1.0, 0.0)}, tmp_path / "a", resume=False)
    with pytest.raises(UserError, match="recipe fast starts from new weights"):
        TrainConfig(dataset, tmp_path / "b", init=str(published), recipe="fast")
    with pytest.raises(UserError, match="recipe continue starts from a finished model"):
        TrainConfig(dataset, tmp_path / "b", recipe="continue")
    with pytest.raises(UserError, match="--batch is 1; batch normalisation needs at least 2"):
        TrainConfig(dataset, tmp_path / "b", batch=1)
    with pytest.raises(UserError, match="--batch is -1; give at least 1"):
        TrainConfig(dataset, tmp_path / "b", init=str(published), recipe="tune", batch=-1)
    grown = {"data": dataset, "init": str(published), "recipe": "continue", "network": "grid"}
    with pytest.raises(UserError, match="from which a grid cannot start"):
        start_training(grown, tmp_path / "c", resume=False)
    _, card = open_pretrained(published)
    pooled = TrainConfig(
        dataset, tmp_path / "d", recipe="continue", init="x", network="regnet_y_400mf"
    )
    with pytest.raises(UserError, match="torchvision's networks cannot be restored"):
        open_training_data(pooled, replace(card, network="regnet_y_400mf"))
    drives = TrainConfig(
        dataset, tmp_path / "f", recipe="tune", init="x", network=card.network, hold_out_drives="a"
    )
    with pytest.raises(UserError, match=r"--hold-out-drives is for pictures with a labels\.csv"):
        open_training_data(drives, card)
    other = replace(card, camera=replace(card.camera, z=1.4))
    tuned = TrainConfig(dataset, tmp_path / "e", recipe="tune", init="x", network=card.network)
    with pytest.raises(UserError, match=r"z 0\.95 instead of 1\.4"):
        open_training_data(tuned, other)


def test_the_card_lists_the_seeds_and_tracks_of_both_trainings(
    published: Path, custom_images: Path
) -> None:
    _, card = open_pretrained(published)
    first = {"path": "datasets/a", "content_hash": "1669", "frames": 10}
    then = {"path": "datasets/b", "content_hash": "28e3", "frames": 20}
    data = {**then, "seeds": [3, 1], "tracks": ["coast"], "earlier": [first]}
    seen = replace(card, data=data)
    about = continue_from_model(custom_training_data(custom_images, card.camera), seen).about
    assert about["tracks"] == ["coast"]
    assert about["seeds"] == {"count": 2, "ranges": "1 3"}
    assert about["earlier"] == [first, then]


def test_numbers_too_small_for_the_processor_are_zero_in_training_alone() -> None:
    """Otherwise the momenta of units that seldom learn make a step take twice as long."""

    def product() -> float:
        return float((torch.full((8,), 1e-37) * 1e-3).max())

    assert product() > 0
    with subnormals_as_zero():
        assert product() == 0
    assert product() > 0


@pytest.mark.parametrize(("count", "alike"), [(1, False), (2, False), (3, True)])
def test_a_single_image_is_enough(
    count: int, alike: bool, published: Path, custom_images: Path, tmp_path: Path
) -> None:
    """Also with two images, and three copies of one; in batches of one, which `tune` allows."""
    table = custom_images / "labels.csv"
    table.write_text("\n".join(table.read_text().splitlines()[: count + 1]) + "\n")
    for number in range(1, count if alike else 1):
        (custom_images / f"{number}.png").write_bytes((custom_images / "0.png").read_bytes())
    options = {"data": custom_images, "init": str(published), "iterations": 1, "batch": 1}
    start_training({**options, "device": "cpu", "threads": 1}, tmp_path / "run", resume=False)
    engine = load_engine(tmp_path / "run", "torch")
    found = evaluate([engine], custom_images, "all")
    assert (found["frames"], found["errors"]["ml"]["frames"]) == (count, count)
    [image] = custom_training_data(custom_images, read_card(published).camera).frames.read_batch(
        np.array([0]), np.empty((1, 210, 280, 3), np.uint8)
    )
    answer = decode_outputs(engine(image))
    assert answer.std is not None
    assert all(value is None or 0 < value < 10 for value in answer.std.values())
    scores = [split_outputs(engine(each)).ood_score for each in (image, 255 - image)]
    assert float(scores[0]) < 1.01 < float(scores[1])  # type: ignore[arg-type]
