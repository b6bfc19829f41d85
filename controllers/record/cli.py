"""The command `controllers record`.

controllers record --controller lqr --rounds 12 --out datasets/driven
"""

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

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
from runtime.cli import AsJson
from trackfeatures import UserError

if TYPE_CHECKING:
    from datagen.cli.collect import ClassShares
    from datagen.planning.plan import Plan

FOLDER = Path("datasets/driven")
FIRST_SEED = 1000
"""Of a recording by default: other rounds than those of a collection with its default."""

ControllerName = Annotated[
    str,
    typer.Option(
        help="lqr, lqr-preview, lqr-paper, mpc, mpc-preview, rl, torcs, a folder of `controllers "
        "train`, or your own class as MODULE:CLASS or FILE.py:CLASS."
    ),
]
Model = Annotated[str, typer.Option(help="Run whose answers are driven on.")]
Out = Annotated[Path, typer.Option(help="Dataset folder; an unfinished one is continued.")]


def record(
    controller: ControllerName = "lqr",
    model: Model = "default",
    rounds: Rounds = 12,
    frames: Frames = CollectConfig.frames,
    out: Out = FOLDER,
    seed: Seed = FIRST_SEED,
    workers: Workers = 0,
    tracks: Tracks = "",
    lanes: Lanes = DEFAULT_LANES,
    lights: Lights = "",
    stretch: Stretch = CollectConfig.stretch,
    scenes: Scenes = CollectConfig.scenes,
    tracks_dir: TracksDir = None,
    split_test_share: TestShare = CollectConfig.test_share,
    split: SplitName = CollectConfig.split,
    as_json: AsJson = False,
) -> None:
    """Record rounds while a controller steers on a model's answers; true labels.

    The rounds are those of `datagen collect`: the controller follows their courses, which sway and
    leave the lane, at their speed and in their traffic. A car that leaves the road or hits
    something is put back onto the road. The same command again continues them.
    """
    from controllers.record.law import MakePerceivedLaw
    from datagen.planning.tracks import choose_tracks

    config = CollectConfig(
        rounds=rounds,
        frames=frames,
        seed=seed,
        tracks=choose_tracks(names(tracks), tracks_dir, unseen=split == UNSEEN),
        lanes=numbers(lanes),
        lights=names(lights) or all_lights(),
        stretch=stretch,
        scenes=scenes,
        test_share=split_test_share,
        split=split,
    )
    plan, classes = _plan(config, tracks_dir, controller, model)
    make_law = MakePerceivedLaw(controller, model)
    result = record_plan(plan, classes, out, workers, tracks_dir, "local", None, make_law)
    print_recorded(result, as_json)


def _plan(
    config: CollectConfig, tracks_dir: Path | None, controller: str, model: str
) -> "tuple[Plan, ClassShares]":
    """The plan of the rounds, which names what drives; and its classes of the heading.

    Raises UserError for a controller that cannot be made, or a model of another camera.
    """
    from controllers.interface import LoopConfig
    from controllers.registry import make_controller
    from datagen.planning.class_balance import TrackForecast
    from datagen.planning.planner import make_plan
    from datagen.planning.summary import expected_classes
    from mtlnet.inference.model_card import read_card, resolve_run

    make_controller(controller, LoopConfig(0.05, noisy=True))
    card = read_card(resolve_run(model))
    if card.camera != config.camera:
        raise UserError(
            f"model {card.name} was trained for {card.camera}, rounds are recorded with "
            f"{config.camera}; give a model of that camera"
        )
    forecast = TrackForecast.of(config.tracks, tracks_dir)
    plan = make_plan(config, forecast)
    # Names of their own, so that they can be merged with the rounds of other plans.
    rounds = tuple(
        replace(entry, id=f"{DRIVEN}{config.seed}-{entry.id.removeprefix('round-')}")
        for entry in plan.rounds
    )
    plan = replace(plan, rounds=rounds, driver={"controller": controller, "model": card.model_hash})
    return plan, expected_classes(plan, forecast)
