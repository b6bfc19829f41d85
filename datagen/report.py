"""`datagen info` as text."""

from typing import Any

import trackfeatures as tf
from datagen.recording.splits import SIDES, UNSEEN


def text(statistics: dict[str, Any]) -> str:
    """The statistics of `datagen.recording.statistics.describe`, for people."""
    lines = [f"{statistics['rounds']} rounds, {statistics['frames']} frames"]
    for name in ("track", "lanes", "light", "traffic", "trajectory"):
        counts = statistics[f"by_{name}"]
        lines.append(f"{name + ':':<12}" + ", ".join(f"{key} {n}" for key, n in counts.items()))
    for side in SIDES:
        lines += _side(side, statistics[side])
    return "\n".join(lines)


def _side(name: str, side: dict[str, Any]) -> list[str]:
    if not side["frames"]:
        return [] if name == UNSEEN else [f"{name}: no frames"]
    classes = ", ".join(f"{kind} {share:.1%}" for kind, share in side["heading"].items())
    lines = [f"{name}: {side['frames']} frames; {classes}"]
    lines.append("  always answering the mean misses by (where active):")
    for feature in (*tf.MARKINGS, "to_lane_centre", "angle"):
        unit = "rad" if feature == "angle" else "m"
        missed, active = side["mean_deviation"][feature], side["active"][feature]
        lines.append(f"  {feature:<15} {missed:7.4f} {unit:<4} active {active:6.1%}")
    speed = side["speed_kmh"]
    lines.append(
        f"  speed {speed['min']:.0f} to {speed['max']:.0f} km/h, median {speed['median']:.0f}"
    )
    return lines
