"""Formats a plan as tables for the terminal."""

from collections import Counter
from collections.abc import Sequence
from typing import Any

from rich.console import Group, RenderableType
from rich.table import Table

import trackfeatures as tf
from datagen.planning.class_balance import MIN_SHARE, Forecast, expected_shares
from datagen.planning.plan import Plan, RoundPlan
from datagen.recording.names import PLACED, SIDES
from datagen.recording.round_metadata import summarize_lights
from simulator.track.random_roads.road import RANDOM, is_random


def expected_classes(plan: Plan, forecast: Forecast) -> dict[str, dict[str, float]]:
    """Return the forecast share of each class of the road by name, for all rounds (key "all") and
    for each side of the split."""
    sides = {"all": list(plan.rounds), **_sides(plan)}
    return {
        name: {
            heading.name.lower(): round(float(share), 4)
            for heading, share in zip(tf.RoadClass, expected_shares(rounds, forecast), strict=True)
        }
        for name, rounds in sides.items()
    }


def overview(plan: Plan, classes: dict[str, dict[str, float]]) -> RenderableType:
    """Return a table with a column for each side of the split: the number of rounds for each value
    of a parameter, and the forecast `classes` (the result of `expected_classes`)."""
    sizes = {entry.frames for entry in plan.rounds}
    of_each = f" of {min(sizes)}" if len(sizes) == 1 else f", {sum(e.frames for e in plan.rounds)}"
    table = Table(title=f"{len(plan.rounds)} rounds{of_each} frames", box=None)
    table.add_column("")
    sides = _sides(plan)
    for side in sides:
        table.add_column(side)
    table.add_row("rounds", *(str(len(rounds)) for rounds in sides.values()))
    tracks = ([_track_group(entry.track) for entry in part] for part in sides.values())
    table.add_row("track", *(_counts(each) for each in tracks))
    for name in ("lanes", "trajectory", "traffic"):
        table.add_row(name, *(_counts([getattr(e, name) for e in part]) for part in sides.values()))
    lights = ([light for e in part for light in e.lights] for part in sides.values())
    table.add_row("light", *(_counts(each) for each in lights))
    shares = (", ".join(f"{k} {v:.0%}" for k, v in classes[side].items()) for side in sides)
    table.add_row("road ahead", *shares)
    return Group(table, *_notes_on_rare_classes(classes))


def listing(plan: Plan) -> RenderableType:
    """Return a table with a row for each round of the plan. Speed and start are "-" for a round
    without a drive."""
    table = Table(box=None)
    names = ("round", "split", "track", "lanes", "traffic", "trajectory", "light", "km/h", "start")
    for name in names:
        table.add_column(name, justify="right" if name in ("km/h", "start") else "left")
    for e in plan.rounds:
        cells = (
            e.id,
            e.split,
            e.track,
            e.lanes,
            e.traffic,
            e.trajectory,
            summarize_lights(e.lights),
        )
        driven = e.trajectory != PLACED
        drive = (f"{e.speed_kmh:.1f}", f"{e.start:.3f}") if driven else ("-", "-")
        table.add_row(*map(str, cells), *drive)
    return table


def _notes_on_rare_classes(classes: dict[str, dict[str, float]]) -> list[str]:
    """Return a line for each class whose forecast share is too small on a side of the split."""
    notes = []
    for name in classes["all"]:
        rare = [
            f"{shares[name]:.0%} of the {side} frames"
            for side, shares in classes.items()
            if side != "all" and shares[name] < MIN_SHARE
        ]
        if rare:
            notes.append(
                f"note: {name} will be {' and '.join(rare)}; other --tracks or more rounds give "
                "more"
            )
    return notes


def _sides(plan: Plan) -> dict[str, list[RoundPlan]]:
    by_side = {side: [entry for entry in plan.rounds if entry.split == side] for side in SIDES}
    return {side: rounds for side, rounds in by_side.items() if rounds}


def _track_group(name: str) -> str:
    """The name under which a track is counted: `random` for all random roads, because each of them
    has only one round."""
    return RANDOM if is_random(name) else name


def _counts(values: Sequence[Any]) -> str:
    counts = Counter(values)
    return ", ".join(f"{value} {count}" for value, count in sorted(counts.items()))
