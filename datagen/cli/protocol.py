"""The command `datagen protocol`.

datagen protocol --out datasets/protocol
"""

from pathlib import Path
from typing import Annotated

import typer

from datagen.cli.collect import TracksDir, Workers, print_recorded, record_plan
from datagen.planning.config import ProtocolConfig, TrackChoice
from runtime.cli import AsJson
from runtime.options import options_of

FOLDER = Path("datasets/protocol")

Out = Annotated[Path, typer.Option(help="Dataset folder; an unfinished one is continued.")]


@options_of(ProtocolConfig)
def protocol(
    config: ProtocolConfig,
    out: Out = FOLDER,
    workers: Workers = 0,
    tracks_dir: TracksDir = None,
    as_json: AsJson = False,
) -> None:
    """Record the test data of the paper's protocol, for `mtlnet evaluate --protocol paper`.

    The data are laps near the middle of g-track-3 and of dirt-3, each in clear light and in heavy
    shadow, and rounds on the paper's nine tracks. The tracks of TORCS are needed. The same command
    continues an interrupted recording.
    """
    from datagen.planning.class_balance import TrackForecast
    from datagen.planning.protocol import protocol_plan
    from datagen.planning.summary import expected_classes

    plan = protocol_plan(config, tracks_dir)
    choices = {entry.track: TrackChoice(entry.track, entry.track_hash) for entry in plan.rounds}
    classes = expected_classes(plan, TrackForecast.of(tuple(choices.values()), tracks_dir))
    print_recorded(record_plan(plan, classes, out, workers, tracks_dir, "local", None), as_json)
