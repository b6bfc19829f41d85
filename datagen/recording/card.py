"""Fills in the template `card.md`; the result is the dataset card, `README.md` of the folder.

Its YAML header is in the format of the Hugging Face hub: huggingface.co/docs/hub/datasets-cards.
"""

from collections.abc import Iterator
from importlib.resources import files
from typing import Any

import trackfeatures as tf
from datagen.recording.dataset import Dataset
from datagen.recording.images import JPEG_QUALITY
from datagen.recording.names import DRIVEN, PLACED, SIDES
from datagen.recording.schema.fields import FIELDS, Field
from datagen.recording.schema.json_schema import SCHEMA_FILE
from datagen.recording.schema.topics import MESSAGE_TYPES
from runtime.cli import counted
from trackfeatures.camera import CameraParameters

SIZE_CATEGORIES = (
    (1_000, "n<1K"),
    (10_000, "1K<n<10K"),
    (100_000, "10K<n<100K"),
    (1_000_000, "100K<n<1M"),
)
LARGEST_CATEGORY = "1M<n<10M"
CODECS = {"jpeg": f"JPEG, quality {JPEG_QUALITY}, 4:2:0", "png": "PNG, lossless"}


def render_card(dataset: Dataset, statistics: dict[str, Any]) -> str:
    """Return the dataset card: Markdown with a YAML header. `statistics` is the result of
    `datagen.recording.statistics.describe`."""
    headers = [index.header for index in dataset.indexes]
    jittered = any(header.nominal_camera for header in headers)
    drives = [header for header in headers if header.trajectory != PLACED]
    hertz = _join({str(header.frequency_hz) for header in drives})
    apart = _join({f"1/{header.frequency_hz}" for header in drives})
    changing = {h.stretch for h in drives if len(h.lights) > 1}  # a light for each scene
    rounds, frames = statistics["rounds"], statistics["frames"]
    template = files("datagen.recording").joinpath("card.md").read_text(encoding="utf-8")
    return template.format(
        name=dataset.path.resolve().name,
        size=next((name for most, name in SIZE_CATEGORIES if frames < most), LARGEST_CATEGORY),
        frames=f"{frames:,}",
        rounds=counted(rounds, "round"),
        hertz=f", {hertz} a second" if drives else "",
        similar=f"Frames of a drive are {apart} s apart and similar"
        if drives
        else "Frames of a round show the same road",
        width=dataset.camera.width,
        height=dataset.camera.height,
        hash=dataset.content_hash,
        first=dataset.rounds[0].path.stem,
        schema=SCHEMA_FILE,
        definitions=tf.VERSION,
        topics="\n".join(
            f"| `{topic}` | {message.DESCRIPTOR.full_name} |"
            for topic, message in MESSAGE_TYPES.items()
        ),
        fields="\n\n".join(_field_table(message) for message in FIELDS),
        program=_join({header.program or "driverview" for header in headers}),
        driven=_describe_drives([header.id for header in drives], len(headers)),
        placed=_describe_placed(len(headers) - len(drives), len(headers)),
        stretches=_describe_stretches(changing - {0}),
        camera=_describe_camera(dataset.camera),
        jitter=", varied a little from round to round (see the metadata of a round)"
        if jittered
        else "",
        one_camera=", nearly" if jittered else "",
        codecs=_join({CODECS[header.codec] for header in headers}),
        sides=_describe_sides(dataset),
        recovered=_describe_recovered(dataset),
        table="\n".join(_table_rows(statistics)),
        **{
            name: _format_counts(statistics[name])
            for name in ("by_track", "by_lanes", "by_traffic", "by_light", "by_trajectory")
        },
    )


def _describe_stretches(frames: set[int]) -> str:
    if not frames:
        return ""
    every = "frame" if frames == {1} else f"{_join({str(count) for count in frames})} frames"
    return (
        f"Every {every} the scenery, the weather and the light change, while the drive goes "
        "on: images\nchange abruptly there, labels and states do not. "
    )


def _describe_camera(camera: CameraParameters) -> str:
    return (
        f"{camera.fov_y_deg:g} degrees of vertical field of view, at ({camera.x:g}, {camera.y:g}, "
        f"{camera.z:g}) m ahead, left and above of the centre of gravity, pitch "
        f"{camera.pitch_deg:g} degrees"
    )


def _describe_drives(ids: list[str], rounds: int) -> str:
    """Describe the rounds with a drive, which have the ids `ids`. `rounds` counts all rounds."""
    if not ids:
        return ""
    who = "A" if len(ids) == rounds else f"In {len(ids)} of {rounds} rounds a"
    text = (
        f"{who} scripted driver drives it; trajectory and speed differ by round; the other cars\n"
        "follow a car-following model.\n"
    )
    count = sum(name.startswith(DRIVEN) for name in ids)
    if count:
        text += (
            f"In {count} of {rounds} rounds (`{DRIVEN}...`, by `controllers record`) a\n"
            "controller steers on a model's answers instead; `plan.json` names both.\n"
        )
    return text


def _describe_placed(count: int, rounds: int) -> str:
    if not count:
        return ""
    return (
        f"In {count} of {rounds} rounds (trajectory `{PLACED}`) the car stands still at another\n"
        "random pose in each frame, among other cars at random places. These frames have no order\n"
        "in time.\n"
    )


def _field_table(message: str) -> str:
    rows = "\n".join(_field_row(name, field) for name, field in FIELDS[message].items())
    return f"`driverview.{message}`:\n\n| field | unit | |\n|---|---|---|\n{rows}"


def _field_row(name: str, field: Field) -> str:
    absent = f"; absent where {field.absent}" if field.absent else ""
    return f"| `{name}` | {field.unit} | {field.meaning}{absent} |"


def _describe_sides(dataset: Dataset) -> str:
    names = {side: [i.id for i in dataset.rounds if i.split == side] for side in (*SIDES, "")}
    return ", ".join(f"{len(ids)} {side or 'of no side'}" for side, ids in names.items() if ids)


def _describe_recovered(dataset: Dataset) -> str:
    found = [index.header.id for index in dataset.indexes if index.recovery]
    return (
        f" Recovered from damaged files, with missing frames: {', '.join(found)}." if found else ""
    )


def _table_rows(statistics: dict[str, Any]) -> Iterator[str]:
    names = [name for name in ("all", *SIDES) if statistics[name]["frames"]]
    sides = [statistics[name] for name in names]
    yield _table_row("", names)
    yield _table_row("---", ["---"] * len(names))
    yield _table_row("frames", [str(side["frames"]) for side in sides])
    for kind in tf.RoadClass:
        name = kind.name.lower()
        yield _table_row(name, [f"{side['heading'][name]:.1%}" for side in sides])
    for name in (*tf.MARKINGS, "to_lane_centre", "angle"):
        unit = "rad" if name == "angle" else "m"
        cells = [
            f"{s['mean_deviation'][name]:.3f} {unit} ({s['active'][name]:.0%} active)"
            for s in sides
        ]
        yield _table_row(f"mean deviation of {name}", cells)


def _table_row(name: str, cells: list[str]) -> str:
    return f"| {name} | {' | '.join(cells)} |"


def _format_counts(counts: dict[str, int]) -> str:
    return ", ".join(f"{name}: {count}" for name, count in counts.items())


def _join(words: set[str]) -> str:
    return " or ".join(sorted(words))
