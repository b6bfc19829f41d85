"""The evaluation as one HTML page that needs nothing beside it: `mtlnet evaluate --report FILE`."""

import base64
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from html import escape
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import Any

import numpy as np
import simplejpeg
from numpy.typing import NDArray

import trackfeatures as tf
from datagen.recording import Frames
from mtlnet.evaluation.metrics import Numbers, signed_errors
from mtlnet.evaluation.slices import GROUPS
from mtlnet.inference.overlay import draw_overlay
from mtlnet.inference.prediction import OUTPUTS, Prediction, decode_outputs
from mtlnet.inference.uncertainty import FEATURES
from runtime.files import atomic_write
from runtime.svg_charts import MOST_POINTS, Line, Plot, plot, reliability, style

PAGE = "report.html"
MOST_DRIVES = 8
HEAVY_SHADOW = 0.3
"""Share of the road in shadow from which a stretch is shaded in the figures."""


def write_page(path: Path, report: dict[str, Any], frames: Frames, outputs: Any) -> Path:
    """Write the page of `mtlnet.evaluation.evaluate`'s report to `path`, or into the folder
    `path`."""
    if path.is_dir():
        path = path / PAGE
    path.parent.mkdir(parents=True, exist_ok=True)
    atomic_write(path, page(report, frames, outputs).encode(), fsync=True)
    return path


def page(report: dict[str, Any], frames: Frames, outputs: NDArray[np.float32]) -> str:
    """HTML of `report` on `outputs` (N, 9 or 17) for `frames`."""
    errors = signed_errors(outputs, frames.labels.distances, frames.labels.angle)
    template = Template(
        files("mtlnet.evaluation").joinpath("report.html").read_text(encoding="utf-8")
    )
    worst = worst_frames(errors, frames.labels.round)
    return template.substitute(
        chart_style=style(),
        model=escape(report["model"]),
        about=escape(
            f"{report['frames']:,} {report['split']} frames in {report['rounds']} rounds of "
            f"{report['data']}; engine {report['engine']}, {report['precision']}"
        ),
        hash=report["model_hash"][:16],
        summary=_summary(report),
        classes=_classes(report),
        presence=_presence(report),
        coded=_coded(report["coded"]),
        drives="".join(_drives(frames, outputs)),
        doubt=_doubt(report),
        worst="".join(figures(frames, outputs, worst)),
        groups="".join(_groups(report)),
    )


def _summary(report: dict[str, Any]) -> str:
    rows = []
    for name in FEATURES:
        unit, digits = ("rad", 4) if name == "angle" else ("m", 3)
        found, guess = report["errors"][name], _mean_error(report["baseline"], name)
        ratio = None if found["mean"] is None or not guess else found["mean"] / guess
        cells = [_number(found[k], digits) for k in ("mean", "median", "p95", "p99")]
        cells += [_number(guess, digits), _number(ratio, 2), f"{found['frames']:,}"]
        rows.append([f"{name} ({unit})", *cells])
    head = ("", "mean", "median", "95 %", "99 %", "mean's answer", "ratio", "frames")
    return _table(head, rows)


def _mean_error(part: dict[str, Any], name: str) -> float | None:
    found: float | None = part["mae_m"].get(name) if name in tf.MARKINGS else None
    if name not in tf.MARKINGS:
        found = part["angle_mae_rad" if name == "angle" else "to_lane_centre_mae_m"]
    return found


def _classes(report: dict[str, Any]) -> str:
    counts = report["confusion"]
    rows = []
    for name, row in counts.items():
        total = sum(row.values())
        shares = [f"{n:,} ({n / total:.1%})" if total else "-" for n in row.values()]
        rows.append([f"truly {name}", *shares])
    right, guess = report["heading_accuracy"], report["baseline"]["heading_accuracy"]
    told = f"<p>{right:.2%} right; always the most frequent class of training: {guess:.1%}.</p>"
    return told + _table(("", *(f"said {name}" for name in counts)), rows)


def _presence(report: dict[str, Any]) -> str:
    rows = [
        [name, _share(rates["false_active"]), _share(rates["false_inactive"])]
        for name, rates in report["presence"].items()
    ]
    return _table(("", "false active", "false inactive"), rows)


def _coded(coded: dict[str, float]) -> str:
    rows = [
        ["distance (five summed)", f"{coded['distance']:.5f}", f"{coded['distance_absolute']:.5f}"],
        ["angle", f"{coded['angle']:.6f}", f"{coded['angle_absolute']:.5f}"],
        ["type (cross-entropy)", f"{coded['type']:.4f}", ""],
    ]
    return _table(("", "mean squared", "mean absolute"), rows)


def _drives(frames: Frames, outputs: NDArray[np.float32]) -> Iterator[str]:
    """The paper's perception figure: a round of each track, offset and angle against the truth."""
    shown: set[str] = set()
    for number, info in enumerate(frames.rounds):
        if info.track in shown or len(shown) == MOST_DRIVES:
            continue
        shown.add(info.track)
        rows = np.flatnonzero(frames.labels.round == number)
        about = f"{info.track}, {info.lanes} lane(s), {info.light} ({info.id})"
        yield f"<h3>{escape(about)}</h3>{_drive(frames, rows, outputs[rows])}"


def _drive(frames: Frames, rows: NDArray[np.int64], outputs: NDArray[np.float32]) -> str:
    labels = frames.labels.take(rows)
    metres = _driven(labels.s.astype(np.float64))
    said = tf.localise(tf.decode(outputs[:, :6])[0])
    angle = tf.decode_values(outputs[:, :6])[:, 5]
    thin = slice(None, None, -(-len(rows) // MOST_POINTS))
    shaded = _spans(metres, labels.shadow_fraction >= HEAVY_SHADOW)
    drawn = []
    for title, unit, true, value, column in (
        ("offset from the lane centre", "m", tf.localise(labels.distances), said, -3),
        ("angle", "rad", labels.angle.astype(np.float64), angle, -2),
    ):
        band = None
        if outputs.shape[1] > OUTPUTS:
            wide = 2 * outputs[:, column].astype(np.float64)
            band = (value - wide)[thin], (value + wide)[thin]
        along = metres[thin]
        lines = [Line("truth", along, true[thin]), Line("said", along, value[thin], band=band)]
        drawn.append(plot(Plot(f"{title} ({unit})", lines, "m driven", shaded)))
    return "".join(drawn)


def _driven(s: Numbers) -> Numbers:
    """Metres since the first frame; crossing the start line is no jump back."""
    steps = np.diff(s)
    steps[steps < 0] = 0.0
    return np.concatenate([[0.0], np.cumsum(steps)])


def _spans(x: Numbers, chosen: NDArray[np.bool_]) -> list[tuple[float, float]]:
    edges = np.flatnonzero(np.diff(np.concatenate([[False], chosen, [False]]).astype(int)))
    last = len(x) - 1
    return [
        (float(x[a]), float(x[min(b, last)])) for a, b in zip(edges[::2], edges[1::2], strict=True)
    ]


def _doubt(report: dict[str, Any]) -> str:
    doubt = report.get("doubt")
    if doubt is None:
        return "<p>This model gives no standard deviations.</p>"
    rows = [[name, *map(_share, shares)] for name, shares in doubt["coverage"].items()]
    table = _table(("", "within 1 &sigma; (68.3 %)", "within 2 &sigma; (95.4 %)"), rows)
    charts = "".join(
        reliability(
            f"{name} ({'rad' if name == 'angle' else 'm'})",
            np.array([part["said"] for part in bins]),
            np.array([part["found"] for part in bins]),
        )
        for name, bins in doubt["calibration"].items()
        if bins
    )
    strange = (
        f"<p>{doubt['out_of_distribution']:.1%} of these frames are called out of distribution."
    )
    return f'{table}<div class="grid small">{charts}</div>{strange}</p>'


def _groups(report: dict[str, Any]) -> Iterator[str]:
    features = [f"{name} ({'rad' if name == 'angle' else 'm'})" for name in FEATURES]
    head = ["frames", *features, "class"]
    for way, label in GROUPS.items():
        rows = []
        for key, part in report[way].items():
            cells = [
                _number(part["errors"][name]["mean"], 4 if name == "angle" else 3)
                for name in FEATURES
            ]
            right = f"{part['heading_accuracy']:.1%}"
            rows.append([escape(key), f"{part['frames']:,}", *cells, right])
        columns = [label, *head]
        if "doubt" in report:
            columns.append("strange")
            for row, part in zip(rows, report[way].values(), strict=True):
                row.append(_share(part["doubt"]["out_of_distribution"]))
        yield _table(columns, rows)


def _table(head: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    """A table; cells are HTML already. The first column names the row."""
    top = "".join(f"<th>{cell}" for cell in head)
    body = "".join(
        "<tr>" + "".join(f"<{'td' if i else 'th'}>{cell}" for i, cell in enumerate(row))
        for row in rows
    )
    return f"<div class=scroll><table><thead><tr>{top}<tbody>{body}</table></div>"


def _number(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def _share(value: float | None) -> str:
    return "-" if value is None else f"{value:.1%}"


# The frames on which a model errs most, with true and answered markings drawn on them.


EACH = 2
"""Frames of each feature..."""
APART = 40
"""...which in the same round lie at least so many frames apart: one bad place is shown once."""
QUALITY = 80


@dataclass(frozen=True)
class Worst:
    """Frame `row`, on which `feature` is `error` (m or rad, signed) off."""

    row: int
    feature: str
    error: float


def worst_frames(errors: Numbers, rounds: NDArray[np.int64]) -> list[Worst]:
    """The `EACH` worst frames of each feature, errors (N, 7); no place is shown twice."""
    chosen: list[Worst] = []
    for i in (5, 6, 0, 1, 3, 2, 4):
        sizes = np.abs(errors[:, i])
        order = np.argsort(-np.nan_to_num(sizes, nan=-1.0), kind="stable")
        found = 0
        for row in order.tolist():
            if found == EACH or np.isnan(sizes[row]):
                break
            if all(abs(row - w.row) >= APART or rounds[row] != rounds[w.row] for w in chosen):
                chosen.append(Worst(row, FEATURES[i], float(errors[row, i])))
                found += 1
    return chosen


def figures(frames: Frames, outputs: NDArray[np.float32], chosen: list[Worst]) -> Iterator[str]:
    """The chosen frames as HTML figures: truth green, answer orange."""
    labels, camera = frames.labels, frames.camera
    for one in chosen:
        answer = decode_outputs(outputs[one.row])
        truth = [None if np.isnan(d) else float(d) for d in labels.distances[one.row]]
        image = draw_overlay(
            frames.image(one.row),
            camera,
            camera.height_above_road_m,
            float(labels.curvature[one.row]),
            (dict(zip(tf.MARKINGS, truth, strict=True)), float(labels.angle[one.row])),
            (answer.distances_m, answer.angle_rad),
        )
        jpeg = simplejpeg.encode_jpeg(np.ascontiguousarray(image), quality=QUALITY)
        yield (
            f'<figure><img src="data:image/jpeg;base64,{base64.b64encode(jpeg).decode()}" '
            f'alt="{one.feature}"><figcaption>{_caption(frames, one, answer)}</figcaption></figure>'
        )


def _caption(frames: Frames, one: Worst, answer: Prediction) -> str:
    labels = frames.labels
    info = frames.rounds[int(labels.round[one.row])]
    unit = "rad" if one.feature == "angle" else "m"
    said = None if answer.std is None else answer.std[one.feature]
    doubt = "" if said is None else f", said to be known to {said:.2g} {unit}"
    strange = ", called out of distribution" if answer.out_of_distribution else ""
    place = f"{info.id}, {info.track}, s = {labels.s[one.row]:.0f} m"
    about = f"{info.lanes} lane(s), {labels.light[one.row]}, {labels.speed[one.row] * 3.6:.0f} km/h"
    return (
        f"<b>{one.feature} {one.error:+.2g} {unit}</b>{doubt}{strange}"
        f"<br><small>{escape(place)}; {escape(about)}</small>"
    )
