"""The page of a dataset: one HTML file that needs nothing beside it."""

import base64
from collections.abc import Iterator
from html import escape
from importlib.resources import files
from string import Template
from typing import Any

import numpy as np
import simplejpeg

import trackfeatures as tf
from datagen.recording.dataset import Dataset
from datagen.recording.labels import Labels
from datagen.recording.splits import SIDES
from datagen.recording.statistics import describe
from datagen.stats.charts import Numbers, bars, histogram
from datagen.stats.concerns import NEEDED, concerns
from datagen.stats.contact_sheet import Card, contact_sheet

KINDS = ("track", "lanes", "trajectory", "traffic")
SHEET_QUALITY = 80


def page(dataset: Dataset) -> str:
    """HTML of distributions, balance and a contact sheet."""
    statistics = describe(dataset)
    labels = dataset.select("all").labels
    sides = np.array([info.split for info in dataset.rounds])[labels.round]
    shown = [side for side in SIDES if side in sides or side in NEEDED]
    parts = {side: labels.take(np.flatnonzero(sides == side)) for side in shown}
    template = Template(files("datagen.stats").joinpath("page.html").read_text())
    return template.substitute(
        name=escape(dataset.path.resolve().name),
        summary=_summary(statistics),
        hash=statistics["content_hash"],
        concerns=_concerns(concerns(statistics, dataset.rounds)),
        balance="".join(_balance(dataset, parts)),
        histograms="".join(_histograms(parts)),
        sheet="".join(_picture(card) for card in contact_sheet(dataset)),
    )


def _summary(statistics: dict[str, Any]) -> str:
    camera = statistics["camera"]
    return (
        f"{statistics['frames']:,} frames in {statistics['rounds']} rounds, {camera['width']} x "
        f"{camera['height']} px, vertical field of view {camera['fov_y_deg']:g}&deg;; "
        f"{statistics['train']['frames']:,} to train, {statistics['test']['frames']:,} to test."
    )


def _concerns(sentences: list[str]) -> str:
    if not sentences:
        return "<p class=good>Nothing stands out: no rare class, no one-sided track or light.</p>"
    return f"<ul class=bad>{''.join(f'<li>{escape(s)}' for s in sentences)}</ul>"


def _balance(dataset: Dataset, parts: dict[str, Labels]) -> Iterator[str]:
    counts = {side: np.bincount(part.heading, minlength=3).tolist() for side, part in parts.items()}
    yield bars(
        "heading class",
        {kind.name.lower(): [counts[side][kind] for side in parts] for kind in tf.Heading},
    )
    sides = list(parts)
    for kind in KINDS:
        frames: dict[str, list[int]] = {}
        for info in dataset.rounds:
            row = frames.setdefault(str(getattr(info, kind)), [0] * len(sides))
            if info.split in sides:
                row[sides.index(info.split)] += info.frames
        yield bars(kind, dict(sorted(frames.items(), key=_in_order)))
    lights = sorted({light for part in parts.values() for light in part.light.tolist()})
    yield bars("light", {k: [int((parts[s].light == k).sum()) for s in parts] for k in lights})


def _in_order(item: tuple[str, Any]) -> tuple[int, str]:
    return (int(item[0]) if item[0].isdigit() else 0, item[0])


def _histograms(parts: dict[str, Labels]) -> Iterator[str]:
    for i, marking in enumerate(tf.MARKINGS):
        yield histogram(marking, "m", {s: part.distances[:, i] for s, part in parts.items()})
    for name, unit, scale in (
        ("to_lane_centre", "m", 1.0),
        ("to_middle", "m", 1.0),
        ("angle", "rad", 1.0),
        ("curvature", "1/m", 1.0),
        ("speed", "km/h", 3.6),
        ("shadow_fraction", "of the road within 30 m", 1.0),
    ):
        columns: dict[str, Numbers] = {s: getattr(p, name) * scale for s, p in parts.items()}
        yield histogram(name.replace("_", " "), unit, columns)


def _picture(card: Card) -> str:
    jpeg = simplejpeg.encode_jpeg(np.ascontiguousarray(card.image), quality=SHEET_QUALITY)
    data = base64.b64encode(jpeg).decode()
    return (
        f'<figure><img src="data:image/jpeg;base64,{data}" alt="{escape(card.about)}">'
        f"<figcaption>{escape(card.about)}<br><small>{escape(card.caption)}</small></figcaption>"
        "</figure>"
    )
