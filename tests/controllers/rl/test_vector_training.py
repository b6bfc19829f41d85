"""Trainings with many cars: resumed to the same bits, curves, the command, refusals."""

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from controllers.laws.actor import Actor, ActorCard, load_actor
from controllers.laws.actor_state import PAPER
from controllers.rl import vector_training
from controllers.rl.cars import Step
from controllers.rl.config import ALGORITHMS, TrainConfig, resolve
from controllers.rl.off_policy import OffPolicy
from controllers.rl.run_folder import prepare_folder
from controllers.rl.training import train
from simulator.track.catalogue import find_track
from tests.typed import error_line, typed
from trackfeatures.errors import UserError

pytest.importorskip("torch")

CARS = 4
UPDATE = 64 * CARS
"""Steps between two updates of PPO."""


@pytest.fixture(autouse=True)
def _short_evaluations(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(vector_training, "EVALUATION_STEPS", 60)


def short(out: Path, **changes: Any) -> TrainConfig:
    """A training of a second."""
    config = TrainConfig(
        out=out,
        algorithm="ppo",
        envs=CARS,
        track="oval",
        steps=3 * UPDATE,
        evaluate_every=UPDATE,
        threads=1,
    )
    return replace(config, **changes)


def actor_of(run: Path) -> tuple[bytes, bytes]:
    return (run / "actor.safetensors").read_bytes(), (run / "actor.json").read_bytes()


@pytest.mark.parametrize(
    ("algorithm", "state"),
    [
        ("ppo", "paper"),
        pytest.param("ppo", "history", marks=pytest.mark.extended),
        ("td3", "paper"),
    ],
)
def test_a_stopped_training_resumes_to_the_same_bits(
    tmp_path: Path, algorithm: str, state: str
) -> None:
    changes = {"algorithm": algorithm, "state": state}
    train(short(tmp_path / "whole", **changes))

    def stop(step: int, best: float) -> None:
        if step == 2 * UPDATE + 10 * CARS:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(short(tmp_path / "parts", **changes), stop)
    stopped = (tmp_path / "parts" / "curve.csv").read_text().splitlines()
    result = train(short(tmp_path / "parts", **changes))

    assert len(stopped) == 3
    assert result["steps"] == 3 * UPDATE
    assert actor_of(tmp_path / "whole") == actor_of(tmp_path / "parts")
    whole, parts = (
        (tmp_path / run / "checkpoint.safetensors").read_bytes() for run in ("whole", "parts")
    )
    begin = [int.from_bytes(data[:8], "little") + 8 for data in (whole, parts)]
    assert whole[begin[0] :] == parts[begin[1] :]


def test_the_same_seed_gives_the_same_actor_and_another_one_another(tmp_path: Path) -> None:
    for name, seed in (("one", 1), ("two", 1), ("other", 2)):
        train(short(tmp_path / name, seed=seed, steps=UPDATE))
    assert actor_of(tmp_path / "one") == actor_of(tmp_path / "two")
    assert actor_of(tmp_path / "one")[0] != actor_of(tmp_path / "other")[0]


def test_the_threads_change_nothing_and_may_change(tmp_path: Path) -> None:
    for name, threads in (("one", 1), ("two", 2)):
        train(short(tmp_path / name, steps=2 * UPDATE, threads=threads))
    assert actor_of(tmp_path / "one") == actor_of(tmp_path / "two")
    again = train(short(tmp_path / "one", steps=2 * UPDATE, threads=2))
    assert again["steps"] == 2 * UPDATE


def test_the_curves_of_a_training(tmp_path: Path) -> None:
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    train(short(tmp_path, reward="quadratic"))
    curve = np.genfromtxt(tmp_path / "curve.csv", delimiter=",", names=True)
    assert curve["step"].tolist() == [UPDATE, 2 * UPDATE, 3 * UPDATE]
    assert curve["score_per_step"].max() < 0.0
    events = EventAccumulator(str(tmp_path / "tensorboard")).Reload()
    drives = events.Scalars("drive/score_per_step")
    assert [point.step for point in drives] == curve["step"].tolist()
    assert [point.value for point in drives] == pytest.approx(curve["score_per_step"].tolist())
    assert [point.step for point in events.Scalars("train/kl")] == curve["step"].tolist()
    card = load_actor(tmp_path).card
    assert (card.algorithm, card.reward, card.track) == ("ppo", "quadratic", "oval")
    assert card.half_width_m == 7.0
    assert card.score_per_step == curve["score_per_step"].max()


def test_the_evaluation_is_the_drive_of_the_command(tmp_path: Path) -> None:
    """Its score is that of `controllers drive` from the same start."""
    train(short(tmp_path, steps=UPDATE))
    done = typed(
        *("controllers", "drive", "--controller", tmp_path, "--track", "oval", "--steps", "60"),
        *("--start-d", str(-14.0 / 6.0), "--json"),
    )
    assert done.returncode == 0, done.stderr
    driven = json.loads(done.stdout)["score_per_step"]
    assert driven == pytest.approx(load_actor(tmp_path).card.score_per_step, abs=1e-6)
    assert driven > 0.3


def test_an_actor_drives_without_torch(tmp_path: Path) -> None:
    train(short(tmp_path, steps=UPDATE))
    code = (
        "import sys; from pathlib import Path; from controllers.laws.rl import load_controller;"
        f"load_controller(Path({str(tmp_path)!r})); assert 'torch' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_defaults_that_depend_on_the_number_of_cars() -> None:
    one, many = resolve(TrainConfig()), resolve(TrainConfig(algorithm="ppo"))
    assert (one.envs, one.track, one.steps, one.evaluate_every) == (1, "forza", 400_000, 20_000)
    assert (many.envs, many.track) == (256, "all")
    assert (many.steps, many.evaluate_every) == (20_000_000, 1_000_000)
    assert resolve(TrainConfig(envs=64)).track == "all"
    assert resolve(TrainConfig(envs=64, steps=5)).steps == 5


def test_the_command_continues_with_the_stored_options(tmp_path: Path) -> None:
    def stop(step: int, best: float) -> None:
        if step > 2 * UPDATE:
            raise KeyboardInterrupt

    out = tmp_path / "run"
    with pytest.raises(KeyboardInterrupt):
        train(short(out, seed=5), stop)
    other = typed("controllers", "train", "--out", out, "--resume", "--seed", "6")
    default = typed("controllers", "train", "--out", out, "--resume", "--seed", "0")
    for found, seed in ((other, 6), (default, 0)):
        begin = f"error: {out} was started with seed 5, now {seed} is given"
        assert error_line(found).startswith(begin)
    done = typed("controllers", "train", "--out", out, "--resume", "--json")
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["steps"] == 3 * UPDATE


def test_a_training_on_all_tracks_is_not_continued_on_other_roads(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tracks = [find_track("oval"), find_track("town")]
    monkeypatch.setattr(vector_training, "list_tracks", lambda folder: tracks)
    config = short(tmp_path, track="all", steps=UPDATE)
    train(config)
    roads = {track.name: track.driving_hash for track in tracks}
    assert json.loads((tmp_path / "config.json").read_text())["roads"] == roads
    train(config)
    for others, message in (
        (["oval"], f"^{tmp_path} was started on other roads: track town is missing now; restore"),
        (["oval", "town", "circuit"], "track circuit was not there; restore"),
        (["circuit"], "track circuit was not there and 2 more; restore"),
    ):
        tracks[:] = map(find_track, others)
        with pytest.raises(UserError, match=message):
            train(config)


@pytest.mark.parametrize(("given", "threads"), [((), 8), (("--threads", "2"), 2)])
def test_resume_keeps_the_threads_of_the_start_unless_others_are_given(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, given: tuple[str, ...], threads: int
) -> None:
    prepare_folder(resolve(short(tmp_path, threads=8)), [])
    configs: list[TrainConfig] = []

    def stored(config: TrainConfig, report: object) -> dict[str, Any]:
        configs.append(config)
        return {"best_score_per_step": 0.0, "best_step": 0}

    monkeypatch.setattr("controllers.rl.training.train", stored)
    done = typed("controllers", "train", "--out", tmp_path, "--resume", *given)
    assert done.returncode == 0, done.stderr
    assert [config.threads for config in configs] == [threads]


@pytest.mark.parametrize("cars", [2, 8, 12, 15, 24])
def test_one_update_follows_eight_control_steps_of_all_cars(cars: int) -> None:
    learner = OffPolicy(replace(ALGORITHMS["td3"], learning_starts=1), PAPER, 0)
    states, none = np.zeros((cars, PAPER.size), np.float32), np.zeros(cars, np.bool_)
    nothing, rewards = np.zeros((cars, 0), np.float32), np.zeros(cars)
    step = Step(states, states, nothing, nothing, rewards, none, none, rewards)
    rng, updated = np.random.default_rng(0), 0
    for number in range(1, 9):
        figures = learner.learn(states, np.zeros(cars, np.float32), step, rng, 1.0)
        updates = learner.store()[1]["updates"]
        assert updates == number * cars // 8
        assert bool(figures) == (updates > updated)
        updated = updates


@pytest.mark.parametrize("algorithm", ["ddpg", "td3"])
def test_the_evaluated_actor_is_the_saved_one(algorithm: str) -> None:
    settings = replace(ALGORITHMS[algorithm], learning_starts=64)
    learner, rng = OffPolicy(settings, PAPER, 0), np.random.default_rng(0)
    states = rng.normal(0.0, 0.3, (64, PAPER.size)).astype(np.float32)
    none = np.zeros(64, np.bool_)
    for _ in range(5):
        actions = learner.explore(states, rng)
        rewards = -np.abs(actions.astype(np.float64) - 0.5)
        nothing = np.zeros((64, 0), np.float32)
        step = Step(states, states, nothing, nothing, rewards, none, none, rewards)
        learner.learn(states, actions, step, rng, 1.0)
    card = ActorCard(
        "paper", PAPER.parts, 5.5, tuple(learner.divisor.tolist()), learner.odd, settings.hidden,
        algorithm, "oval", 0, 0, 0.0,
    )  # fmt: skip
    saved = Actor(card, learner.weights())
    steered = [saved.steer(state) for state in states]
    np.testing.assert_allclose(learner.act(states), steered, atol=1e-5)


@pytest.mark.parametrize("words", [("--envs", "0"), ("--disturbed", "1.5"), ("--threads", "0")])
def test_numbers_out_of_range_are_refused(words: tuple[str, ...]) -> None:
    done = typed("controllers", "train", *words)
    assert done.returncode == 2
    assert words[0] in done.stderr


def test_errors_of_images_and_disturbances_need_several_cars(tmp_path: Path) -> None:
    out = tmp_path / "run"
    done = typed("controllers", "train", "--image-errors", "--out", out)
    assert error_line(done).startswith("error: --image-errors needs several cars; give --envs")
    assert not out.exists()
    done = typed("controllers", "train", "--disturbed", "0.9", "--out", out)
    assert error_line(done).startswith("error: --disturbed needs several cars; give --envs")
    train(short(out, image_errors=True))
    assert json.loads((out / "config.json").read_text())["image_errors"]


def test_a_damaged_checkpoint_is_refused(tmp_path: Path) -> None:
    train(short(tmp_path, steps=UPDATE))
    path = tmp_path / "checkpoint.safetensors"
    path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(UserError, match=r"checkpoint .* cannot be read"):
        train(short(tmp_path, steps=UPDATE))
