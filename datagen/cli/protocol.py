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

Out = Annotated[
    Path, typer.Option(help="Dataset folder to write; an unfinished dataset in it is continued.")
]


@options_of(ProtocolConfig)
def protocol(
    config: ProtocolConfig,
    out: Out = FOLDER,
    workers: Workers = 0,
    tracks_dir: TracksDir = None,
    as_json: AsJson = False,
) -> None:
    """Record the drives on which `mtlnet evaluate --protocol paper` evaluates a model.

    They are similar to the test drives of the paper (Li et al., "Reinforcement Learning and Deep
    Learning based Lateral Control for Autonomous Driving"). There are four drives near the middle
    of a one-lane road: on the tracks g-track-3 and dirt-3, each in clear light and in heavy shadow.
    There are also rounds on nine tracks: the six that the paper names, and three others. All these
    tracks belong to TORCS, so TORCS must be installed, or --tracks-dir must contain its tracks. To
    continue an interrupted recording, run the same command again.
    """
    from datagen.planning.class_balance import TrackForecast
    from datagen.planning.protocol import protocol_plan
    from datagen.planning.summary import expected_classes

    plan = protocol_plan(config, tracks_dir)
    choices = {entry.track: TrackChoice(entry.track, entry.track_hash) for entry in plan.rounds}
    classes = expected_classes(plan, TrackForecast.of(tuple(choices.values()), tracks_dir))
    print_recorded(record_plan(plan, classes, out, workers, tracks_dir, "local", None), as_json)
