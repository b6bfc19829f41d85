"""Draws a picture of a track: its plan, and height, curvature and class of the road along the lap.

simulator tracks plot NAME --out FILE.png --lanes 2
"""

import io
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

import trackfeatures as tf
from runtime.files import atomic_write, check_folder
from simulator.arrays import FloatArray
from simulator.track.geometry import Track, TrackPose
from simulator.track.road import Road
from trackfeatures.errors import UserError
from trackfeatures.road_class import BEND_CURVATURE

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


COLOURS: Final = {
    tf.RoadClass.LEFT: "#1f6fb4",
    tf.RoadClass.STRAIGHT: "#5f6b7a",
    tf.RoadClass.RIGHT: "#d1661b",
}
INK, FAINT, PAPER, GRASS, ASPHALT = "#1d2733", "#c9d0d8", "#ffffff", "#dfe8d8", "#8d949c"
TICKS_M: Final = (50, 100, 200, 250, 500, 1000, 2000, 5000)
MOST_TICKS: Final = 16
MOST_SAMPLES: Final = 6000
DPI: Final = 110


@dataclass(frozen=True)
class Lap:
    """A road sampled evenly round the lap, including both ends; all arrays (N,)."""

    road: Road
    s: FloatArray
    centre: TrackPose
    classes: NDArray[np.int64]
    """Class of the road at each s."""

    @property
    def shares(self) -> dict[tf.RoadClass, float]:
        """Share of the lap in each class."""
        return {kind: float(np.mean(self.classes[:-1] == kind)) for kind in tf.RoadClass}


def sample(road: Road) -> Lap:
    """Sample the lap of `road` at equal distances of about 1 m, or at 6001 points if the lap is
    longer than 6 km."""
    track = road.track
    count = min(round(track.length_m), MOST_SAMPLES)
    s = np.linspace(0.0, track.length_m, count + 1)
    centre = track.at(s)
    ahead = track.at(s + tf.LOOK_AHEAD_M).curvature
    classes = [
        int(tf.classify_heading(float(here), float(there)))
        for here, there in zip(centre.curvature, ahead, strict=True)
    ]
    return Lap(road, s, centre, np.array(classes))


def runs(classes: NDArray[np.int64]) -> list[tuple[int, int, tf.RoadClass]]:
    """Split `classes` (N,) of the samples round the lap into stretches of one class. Returns (index
    of the first sample, index of the last sample + 1, class) of each stretch."""
    cuts = np.flatnonzero(np.diff(classes)) + 1
    bounds = [0, *cuts.tolist(), len(classes)]
    return [(first, last, tf.RoadClass(int(classes[first]))) for first, last in pairwise(bounds)]


def write_plot(road: Road, out: Path) -> None:
    """Write the picture of `road` as a PNG file of 1760 x 990 pixels.

    An existing file is replaced only when the new one is complete. Raises UserError for a name
    without .png, a missing folder or missing matplotlib, and OSError if the file cannot be written.
    """
    if out.suffix.lower() != ".png":
        raise UserError(f"{out}: the plot is a PNG file; give a name that ends in .png")
    check_folder(out)
    buffer = io.BytesIO()
    draw(sample(road)).savefig(buffer, format="png", dpi=DPI, facecolor=PAPER)
    atomic_write(out, buffer.getvalue())


def draw(lap: Lap) -> "Figure":
    """Draw the figure without a window, a display or matplotlib's global state."""
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
        from matplotlib.layout_engine import ConstrainedLayoutEngine
    except ImportError as error:
        raise UserError(f"plots need matplotlib ({error}); pip install matplotlib") from None
    figure = Figure(figsize=(16, 9), layout=ConstrainedLayoutEngine(w_pad=0.12, h_pad=0.08))
    FigureCanvasAgg(figure)
    grid = figure.add_gridspec(4, 2, width_ratios=(1.15, 1.0), height_ratios=(3.0, 3.0, 0.55, 1.5))
    _plan(figure.add_subplot(grid[:, 0]), lap)
    height = figure.add_subplot(grid[0, 1])
    _height(height, lap)
    _curvature(figure.add_subplot(grid[1, 1], sharex=height), lap)
    _classes(figure.add_subplot(grid[2, 1], sharex=height), lap)
    _cross_section(figure.add_subplot(grid[3, 1]), lap.road)
    name = lap.road.track.name.replace("$", "\\$")  # a plain $ would begin a formula
    figure.suptitle(name, x=0.012, ha="left", fontsize=17, color=INK, weight="bold")
    return figure


def _facts(track: Track) -> str:
    fall, rise = track.grade_range
    return (
        f"{track.length_m:,.0f} m, {track.width:g} m wide, {track.surface}; least radius "
        f"{track.min_radius_m:.0f} m; heights {track.z_range_m:.1f} m apart, "
        f"grade {100 * fall:+.1f} to {100 * rise:+.1f} %"
    )


def _plan(axes: "Axes", lap: Lap) -> None:
    track = lap.road.track
    left, right = track.at(lap.s, lap.road.edge), track.at(lap.s, -lap.road.edge)
    axes.fill(
        np.r_[left.x, right.x[::-1]], np.r_[left.y, right.y[::-1]], color=FAINT, lw=2.5, zorder=1
    )
    for first, last, kind in runs(lap.classes):
        part = slice(first, last + 1)
        axes.plot(lap.centre.x[part], lap.centre.y[part], color=COLOURS[kind], lw=2.4, zorder=3)
    _distances(axes, lap)
    _start(axes, lap)
    axes.set_aspect("equal", adjustable="datalim")
    axes.margins(0.07)
    axes.set(xlabel="x (m)", ylabel="y (m)")
    axes.set_title(_facts(track), loc="left", fontsize=10.5, color=INK)
    _bare(axes)
    shares = lap.shares
    for kind in tf.RoadClass:
        axes.plot(
            [], [], color=COLOURS[kind], lw=4, label=f"{kind.name.lower()} {shares[kind]:.0%}"
        )
    axes.legend(loc="best", frameon=True, framealpha=0.85, edgecolor=FAINT, title="heading class")


def _distances(axes: "Axes", lap: Lap) -> None:
    """Draw ticks across the road at equal distances. Write the distance (m) from the start line
    beside each tick, on the outer side of the loop."""
    from matplotlib.patheffects import withStroke

    track = lap.road.track
    step = tick_step(track.length_m)
    s = np.arange(step, track.length_m - 0.4 * step, step, dtype=np.float64)
    pose = track.at(s)
    span = float(max(np.ptp(lap.centre.x), np.ptp(lap.centre.y)))
    turned = float(np.sum(track.curvature0 * track.length))
    side = -1.0 if turned > 0.0 else 1.0  # the outer side: right, if the loop turns left
    across = np.stack((-np.sin(pose.heading), np.cos(pose.heading)))
    reach = 0.011 * span
    halo = [withStroke(linewidth=2.5, foreground=PAPER)]
    for k, distance in enumerate(s):
        place = np.array([pose.x[k], pose.y[k]])
        ends = place + np.outer((-reach, reach), across[:, k])
        axes.plot(ends[:, 0], ends[:, 1], color=INK, lw=1.1, zorder=4)
        axes.annotate(
            f"{distance:,.0f}",
            _point(place + side * reach * across[:, k]),
            # The horizontal distance is larger, because the text of a number is wider than high.
            _point(side * across[:, k] * (18.0, 9.0)),
            textcoords="offset points",
            ha="center",
            va="center",
            fontsize=8,
            color=INK,
            zorder=5,
            path_effects=halo,
        )


def _point(xy: FloatArray) -> tuple[float, float]:
    return float(xy[0]), float(xy[1])


def tick_step(length: float) -> int:
    """Return a round distance (m) between the ticks of a lap of `length` m, so that there are at
    most 16 ticks."""
    return next((step for step in TICKS_M if length / step <= MOST_TICKS), 10_000)


def _start(axes: "Axes", lap: Lap) -> None:
    """Draw the start line and, beside it, an arrow in driving direction."""
    track = lap.road.track
    span = float(max(np.ptp(lap.centre.x), np.ptp(lap.centre.y)))
    turned = float(np.sum(track.curvature0 * track.length))
    side = 1.0 if turned > 0.0 else -1.0
    line = track.at([0.0, 0.0], [0.02 * span, -0.02 * span])
    axes.plot(line.x, line.y, color=INK, lw=3.5, zorder=6)
    foot = track.at(0.0, side * 0.035 * span)
    heading = float(track.at(0.0).heading)
    tip = 0.10 * span * np.array([np.cos(heading), np.sin(heading)])
    place = np.array([float(foot.x), float(foot.y)])
    axes.annotate(
        "",
        _point(place + tip),
        _point(place),
        arrowprops={"arrowstyle": "-|>", "color": INK, "lw": 2, "mutation_scale": 18},
        zorder=6,
    )
    beside = track.at(0.0, side * 0.062 * span)
    at = np.array([float(beside.x), float(beside.y)]) + tip / 2
    axes.annotate(
        "start", _point(at), ha="center", va="center", fontsize=10, color=INK, weight="bold"
    )


def _height(axes: "Axes", lap: Lap) -> None:
    z = lap.centre.z
    low = float(z.min())
    margin = max(0.08 * float(np.ptp(z)), 1.0)
    for first, last, kind in runs(lap.classes):
        part = slice(first, last + 1)
        axes.fill_between(lap.s[part], z[part], low - margin, color=COLOURS[kind], alpha=0.18, lw=0)
    axes.plot(lap.s, z, color=INK, lw=1.4)
    axes.set_ylim(low - margin, float(z.max()) + margin)
    axes.set_xlim(0.0, lap.road.track.length_m)
    axes.set_ylabel("height (m)")
    axes.tick_params(labelbottom=False)
    _bare(axes)


def _curvature(axes: "Axes", lap: Lap) -> None:
    k = 1000.0 * lap.centre.curvature
    for first, last, kind in runs(lap.classes):
        part = slice(first, last + 1)
        axes.fill_between(lap.s[part], k[part], color=COLOURS[kind], alpha=0.35, lw=0, step="post")
    axes.plot(lap.s, k, color=INK, lw=1.0, drawstyle="steps-post")
    for limit in (-1000.0 * BEND_CURVATURE, 1000.0 * BEND_CURVATURE):
        axes.axhline(limit, color=INK, lw=0.8, ls=(0, (4, 4)), alpha=0.6)
    most = max(1.15 * float(np.abs(k).max()), 3000.0 * BEND_CURVATURE)
    axes.set_ylim(-most, most)
    axes.set_ylabel("curvature (1/km)\nright $-$   $+$ left")
    axes.tick_params(labelbottom=False)
    _bare(axes)


def _classes(axes: "Axes", lap: Lap) -> None:
    for first, last, kind in runs(lap.classes):
        end = lap.s[min(last, len(lap.s) - 1)]
        axes.axvspan(lap.s[first], end, color=COLOURS[kind], lw=0)
    axes.set(yticks=[], ylabel="class", xlabel="s (m)")
    _bare(axes)


def _cross_section(axes: "Axes", road: Road) -> None:
    """Draw the road's cross-section as the driver sees it: left is left, heights not to scale."""
    wall, edge, asphalt = road.wall_offset, road.edge, road.half_asphalt
    axes.axvspan(-wall, wall, ymax=0.35, color=GRASS, lw=0)
    axes.axvspan(-asphalt, asphalt, ymax=0.35, color=ASPHALT, lw=0)
    for y in road.markings_y:
        outer = abs(abs(y) - road.lanes * road.lane_width / 2) < 1e-9
        axes.plot([y, y], [0.12, 0.35], color=PAPER, lw=4, ls="-" if outer else (0, (0.7, 0.5)))
    for y in (-wall, wall):
        axes.plot([y, y], [0.0, 0.85], color=INK, lw=5, solid_capstyle="butt")
    for y in (-edge, edge):
        axes.plot([y, y], [0.35, 0.55], color=INK, lw=1)
        axes.annotate("edge", (y, 0.6), ha="center", va="bottom", fontsize=8, color=INK)
    plural = "lane" if road.lanes == 1 else "lanes"
    text = f"{road.lanes} {plural} of {road.lane_width:g} m, asphalt {2 * asphalt:g} m"
    axes.annotate(text, (0.0, 0.6), ha="center", va="bottom", fontsize=9, color=INK)
    axes.set(xlim=(wall + 1.0, -wall - 1.0), ylim=(0.0, 1.0), yticks=[], xlabel="left (m)")
    axes.set_ylabel("road")
    _bare(axes)


def _bare(axes: "Axes") -> None:
    axes.spines[["top", "right"]].set_visible(False)
    settings: dict[str, Any] = {"color": FAINT, "lw": 0.6, "alpha": 0.7}
    axes.grid(visible=True, **settings)
    axes.set_axisbelow(True)
    axes.tick_params(labelsize=9)
