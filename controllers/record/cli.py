"""The command `controllers record`.

controllers record --controller lqr --rounds 12 --out datasets/driven
"""

import hashlib
import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from controllers import cli_options as options
from datagen.cli.collect import (
    DEFAULT_LANES,
    Lanes,
    Lights,
    Tracks,
    TracksDir,
    Workers,
    names,
    numbers,
    print_recorded,
    record_plan,
)
from datagen.planning.config import (
    CollectConfig,
    Frames,
    Rounds,
    Scenes,
    Seed,
    SplitName,
    Stretch,
    TestShare,
    all_lights,
)
from datagen.recording.names import DRIVEN, UNSEEN
from trackfeatures import UserError

if TYPE_CHECKING:
    from datagen.cli.collect import ClassShares
    from datagen.planning.plan import Plan

FOLDER = Path("datasets/driven")
FIRST_SEED = 1000
"""Default seed. It differs from the default of `datagen collect`, so the rounds differ too."""


@dataclass(frozen=True)
class RecordConfig:
    """One recording. All options except the controller and the model are also options of `datagen
    collect`."""

    controller: options.ControllerName = "lqr"
    model: Annotated[str, f"Model on whose answers the car drives: {options.MODELS}"] = "default"
    rounds: Rounds = 12
    frames: Frames = CollectConfig.frames
    out: Annotated[Path, "Dataset folder to write; an unfinished dataset in it is continued."] = (
        FOLDER
    )
    seed: Seed = FIRST_SEED
    workers: Workers = 0
    tracks: Tracks = ""
    lanes: Lanes = DEFAULT_LANES
    lights: Lights = ""
    stretch: Stretch = CollectConfig.stretch
    scenes: Scenes = CollectConfig.scenes
    tracks_dir: TracksDir = None
    split_test_share: TestShare = CollectConfig.test_share
    split: SplitName = CollectConfig.split


@options.options(RecordConfig)
def record(config: RecordConfig, as_json: bool) -> None:
    """Record rounds with true labels while a controller steers on a model's answers.

    A round is one recorded drive, with its images and labels in one file. The rounds are planned
    like the rounds of `datagen collect`, with the same speeds and traffic. The controller follows
    the planned path of a round, which sways and also leaves the lane. A car that leaves the road or
    hits something is put back onto the road. To continue an interrupted dataset, run the same
    command again.
    """
    from controllers.record.law import MakePerceivedLaw
    from mtlnet.inference.model_card import resolve_run

    # "latest" may become another run while the rounds are recorded.
    config = replace(config, model=str(resolve_run(config.model)))
    plan, classes = _plan(config)
    make_law = MakePerceivedLaw(config.controller, config.model)
    result = record_plan(
        *(plan, classes, config.out, config.workers, config.tracks_dir),
        *("local", None, make_law),
    )
    print_recorded(result, as_json)


def _plan(config: RecordConfig) -> "tuple[Plan, ClassShares]":
    """Return the plan of the rounds, and the expected shares of the road classes. `config.model` is
    a folder. The plan has the name of the controller, the hash of the model's weights, and a hash
    of the files of both.

    Raises UserError for a controller that cannot be made, or a model for another camera.
    """
    from controllers.interface import LoopConfig
    from controllers.registry import controller_code, make_controller
    from datagen.planning.class_balance import TrackForecast
    from datagen.planning.plan import DRIVER_FILES
    from datagen.planning.planner import make_plan
    from datagen.planning.summary import expected_classes
    from datagen.planning.tracks import choose_tracks
    from mtlnet.inference.model_card import read_card

    collected = CollectConfig(
        rounds=config.rounds,
        frames=config.frames,
        seed=config.seed,
        tracks=choose_tracks(
            names(config.tracks), config.tracks_dir, unseen=config.split == UNSEEN
        ),
        lanes=numbers(config.lanes),
        lights=names(config.lights) or all_lights(),
        stretch=config.stretch,
        scenes=config.scenes,
        test_share=config.split_test_share,
        split=config.split,
    )
    make_controller(config.controller, LoopConfig(0.05, noisy=True))
    card = read_card(Path(config.model))
    if card.camera != collected.camera:
        raise UserError(
            f"model {card.name} was trained for {card.camera}, rounds are recorded with "
            f"{collected.camera}; give a model of that camera"
        )
    forecast = TrackForecast.of(collected.tracks, config.tracks_dir)
    plan = make_plan(collected, forecast)
    # The rounds get other names, so that they can be merged with the rounds of other plans.
    rounds = tuple(
        replace(entry, id=f"{DRIVEN}{config.seed}-{entry.id.removeprefix('round-')}")
        for entry in plan.rounds
    )
    content = controller_code(config.controller) + json.dumps(card.files, sort_keys=True).encode()
    files = hashlib.sha256(content).hexdigest()
    driver = {"controller": config.controller, "model": card.model_hash, DRIVER_FILES: files}
    plan = replace(plan, rounds=rounds, driver=driver)
    return plan, expected_classes(plan, forecast)
