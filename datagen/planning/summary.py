"""A plan for people: what will be recorded, before it is."""

from collections import Counter
from collections.abc import Sequence
from typing import Any

from rich.console import Group, RenderableType
from rich.table import Table

import trackfeatures as tf
from datagen.planning.class_balance import LEAST_SHARE, Forecast, expected_shares
from datagen.planning.plan import Plan, RoundPlan
from datagen.recording.round_metadata import summarize_lights
from datagen.recording.splits import SIDES


def expected_classes(plan: Plan, forecast: Forecast) -> dict[str, dict[str, float]]:
    """Share of each class of the road ahead that is to be expected, of all and of either side."""
    sides = {"all": list(plan.rounds), **_sides(plan)}
    return {
        name: {
            kind.name.lower(): round(float(share), 4)
            for kind, share in zip(tf.Heading, expected_shares(rounds, forecast), strict=True)
        }
        for name, rounds in sides.items()
    }


def overview(plan: Plan, classes: dict[str, dict[str, float]]) -> RenderableType:
    """How many rounds of what; the classes to be expected of either side."""
    table = Table(title=f"{len(plan.rounds)} rounds of {plan.wanted.frames} frames", box=None)
    table.add_column("")
    sides = _sides(plan)
    for side in sides:
        table.add_column(side)
    table.add_row("rounds", *(str(len(rounds)) for rounds in sides.values()))
    for name in ("track", "lanes", "trajectory", "traffic"):
        table.add_row(name, *(_counts([getattr(e, name) for e in part]) for part in sides.values()))
    lights = ([light for e in part for light in e.lights] for part in sides.values())
    table.add_row("light", *(_counts(each) for each in lights))
    shares = (", ".join(f"{k} {v:.0%}" for k, v in classes[side].items()) for side in sides)
    table.add_row("road ahead", *shares)
    return Group(table, *_rare(classes))


def listing(plan: Plan) -> RenderableType:
    """One row a round."""
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
        table.add_row(*map(str, cells), f"{e.speed_kmh:.1f}", f"{e.start:.3f}")
    return table


def _rare(classes: dict[str, dict[str, float]]) -> list[str]:
    """What even the best starts cannot give."""
    return [
        f"note: {kind} will be {share:.0%} of all frames; other --tracks, or more rounds, have more"
        for kind, share in classes["all"].items()
        if share < LEAST_SHARE
    ]


def _sides(plan: Plan) -> dict[str, list[RoundPlan]]:
    of = {side: [entry for entry in plan.rounds if entry.split == side] for side in SIDES}
    return {side: rounds for side, rounds in of.items() if rounds}


def _counts(values: Sequence[Any]) -> str:
    counts = Counter(values)
    return ", ".join(f"{value} {count}" for value, count in sorted(counts.items()))
