"""The command `datagen protocol`.

datagen protocol --out datasets/protocol
"""

from pathlib import Path
from typing import Annotated

import typer

from datagen.cli.collect import TracksDir, Workers, print_recorded, record_plan
from datagen.planning.config import ProtocolConfig, TrackChoice
from runtime.cli import AsJson

FOLDER = Path("datasets/protocol")

Rounds = Annotated[int, typer.Option(help="Rounds on the nine tracks.")]
Frames = Annotated[int, typer.Option(help="Frames of each of these rounds.")]
Laps = Annotated[float, typer.Option(help="Laps of each of the four drives.")]
Seed = Annotated[int, typer.Option(help="Seed of everything random.")]
Out = Annotated[Path, typer.Option(help="Dataset folder; an unfinished one is continued.")]


def protocol(
    out: Out = FOLDER,
    rounds: Rounds = ProtocolConfig.rounds,
    frames: Frames = ProtocolConfig.frames,
    laps: Laps = ProtocolConfig.laps,
    seed: Seed = ProtocolConfig.seed,
    workers: Workers = 0,
    tracks_dir: TracksDir = None,
    as_json: AsJson = False,
) -> None:
    """Record what the paper tests its perception on, for `mtlnet evaluate --protocol paper`.

    A lap near the middle of g-track-3 and of dirt-3, in clear light and in heavy shadow, and rounds
    on the paper's nine tracks. Needs the tracks of TORCS. The same command again continues it.
    """
    from datagen.planning.class_balance import TrackForecast
    from datagen.planning.protocol import protocol_plan
    from datagen.planning.summary import expected_classes

    plan = protocol_plan(ProtocolConfig(rounds, frames, laps, seed), tracks_dir)
    choices = {entry.track: TrackChoice(entry.track, entry.track_hash) for entry in plan.rounds}
    classes = expected_classes(plan, TrackForecast.of(tuple(choices.values()), tracks_dir))
    print_recorded(record_plan(plan, classes, out, workers, tracks_dir, "local", None), as_json)
