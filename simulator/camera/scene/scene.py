"""Everything that stands still in one round: road, land, and their colours."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from simulator.camera.bridges import bridges
from simulator.camera.core.context import SCENE_BINDING, SHADE_UNIT, Graphics
from simulator.camera.core.mesh import Mesh, Surface
from simulator.camera.core.optics import Eye
from simulator.camera.scene import barriers, land, props
from simulator.camera.scene import road_mesh as ribbon
from simulator.camera.scene import shadow_mask as shade
from simulator.camera.scene.light import Light
from simulator.camera.scene.terrain import COARSEST, Survey
from simulator.camera.scene.terrain import build as build_terrain
from simulator.camera.scene.themes import Colour, Look, look_of
from simulator.camera.vegetation import scenery
from simulator.camera.vegetation.trees import Corners, Woods
from simulator.track.road import Road

FloatArray = NDArray[np.float64]

LAND = (
    land.Span(1, 0.0, 40.0, bare=False),
    land.Span(2, 40.0, 120.0, bare=False),
    land.Span(4, 120.0, 350.0, bare=True),
    land.Span(COARSEST, 350.0, 2500.0, bare=True),
)
_CONCRETE: Colour = (0.21, 0.205, 0.19)
_LINE = {"white": (0.78, 0.78, 0.75), "yellow": (0.75, 0.50, 0.06)}


@dataclass(frozen=True)
class Seen:
    """What of a scene one eye may see: runs of indices of its meshes, corners of its trees."""

    solid: tuple[tuple[Mesh, list[list[int]]], ...]
    barriers: list[list[int]]
    trees: Corners


class Scene:
    """The still world of one road and seed; `draw` paints it with the frame that is set."""

    def __init__(
        self, graphics: Graphics, road: Road, survey: Survey, seed: int, light: Light
    ) -> None:
        def rng(part: int) -> np.random.Generator:
            return np.random.default_rng([seed, part])

        look = look_of(road.track.look)
        terrain = build_terrain(road, survey, look, rng(1))
        ground = ribbon.Ground.of(road, survey.line, terrain)
        over = bridges.build(ground, look, rng(8))
        trees = scenery.plant(ground, look, over, rng(3), avenue=light.canopy)
        shadiness = land.Shadiness.of(terrain, survey.line, trees, light)
        rails = barriers.build(road, ground.mesh, look, rng(5))
        built = props.build(ground, look, over, rng(6))
        covered = ribbon.covers(ground.mesh, survey, margin_m=2.0)
        self.mask = shade.build(road, trees, over, shadiness, light, rng(4))
        self._woods = Woods(graphics, trees, light.weather)
        self._barriers = Mesh(
            graphics,
            graphics.weathered("barrier", light.weather),
            rails,
            ("3f 2f 1f 3f", "at", "along", "kind", "facing"),
        )
        self._solid = (
            *_road_meshes(graphics, ribbon.surfaces(ground.mesh, road), light.weather),
            *_prop_meshes(graphics, built, light.weather),
            *_land_meshes(graphics, shadiness, covered, light.weather, look.sea),
        )
        palette = scene_block(road, look, rng(2), self.mask, terrain.sea)
        self._block = graphics.context.buffer(palette.tobytes())
        texels = self.mask.texels
        self._shade = graphics.context.texture(texels.shape[::-1], 1, texels.tobytes())
        graphics.mipmapped(self._shade)
        self._shade.filter = graphics.noise.filter

    def seen(self, eye: Eye, planes: FloatArray) -> Seen:
        """What to draw for an eye with the side planes `planes` (4, 3)."""
        return Seen(
            tuple((mesh, mesh.seen(eye.place, planes)) for mesh in self._solid),
            self._barriers.seen(eye.place, planes),
            self._woods.seen(eye.place, planes, from_above=eye.axes[2, 2] < -0.9),
        )

    def draw(self, seen: Seen, labels: bool) -> None:
        """Paint everything but the sky; nearest first, so that hidden pixels cost little."""
        self._block.bind_to_uniform_block(SCENE_BINDING)
        self._shade.use(SHADE_UNIT)
        self._woods.draw(seen.trees, "labels" if labels else "core")
        for mesh, runs in seen.solid:
            mesh.draw(runs, labels)
        if labels:
            self._barriers.draw(seen.barriers, labels)

    def draw_blended(self, seen: Seen) -> None:
        """Paint what lets light through, after all else."""
        self._barriers.draw(seen.barriers, labels=False)
        self._woods.draw(seen.trees, "fringe")

    def release(self) -> None:
        """Free the graphics memory."""
        for mesh in (*self._solid, self._barriers):
            mesh.release()
        self._woods.release()
        self._block.release()
        self._shade.release()


def _road_meshes(graphics: Graphics, surfaces: tuple[Surface, Surface], weather: str) -> list[Mesh]:
    """The asphalt, then the verges beside it."""
    layout = ("3f 2f 3f 1f", "at", "road", "facing", "kerbed")
    return [
        Mesh(graphics, graphics.weathered(program, weather), surface, layout)
        for program, surface in zip(("paved", "verge"), surfaces, strict=True)
    ]


def _prop_meshes(graphics: Graphics, props: dict[str, Surface], weather: str) -> list[Mesh]:
    """Props and bridges, one mesh for each material."""
    layout = ("3f 3f 3f 2f", "at", "facing", "colour", "face")
    return [
        Mesh(graphics, graphics.weathered("prop", weather, material), surface, layout)
        for material, surface in props.items()
    ]


def _land_meshes(
    graphics: Graphics,
    shadiness: land.Shadiness,
    covered: NDArray[np.bool_],
    weather: str,
    sea: bool,
) -> list[Mesh]:
    """The terrain, one mesh for each range of distance."""
    program = graphics.weathered("land", weather, *(["sea"] if sea else []))
    layout = ("3f 3f 1f", "at", "facing", "sunlit")
    return [
        Mesh(graphics, program, land.surface(shadiness, covered, span), layout) for span in LAND
    ]


def scene_block(
    road: Road, look: Look, rng: np.random.Generator, mask: shade.ShadeMask, sea: float
) -> NDArray[np.float32]:
    """The uniform block `Scene` of frame.glsl, (10, 4) float32."""
    marks, concrete = road.track.markings, road.track.surface == "concrete"
    tone = rng.uniform(0.72, 1.35)
    worn = float(np.clip(look.worn * rng.uniform(0.4, 1.5), 0.0, 1.0))
    missing = float(rng.choice([0.0, 0.05, 0.12], p=[0.5, 0.3, 0.2])) if marks.wear > 0.0 else 0.0
    grassy = float(np.clip(rng.normal(look.grassy, 0.3 * min(1.0, 3.0 * look.grassy)), 0.0, 1.0))
    fade = rng.uniform(0.8, 1.05)
    # Where nothing grows the pavement reaches to the houses' walls.
    paved_to = road.edge if look.grassy > 0.0 else road.wall_offset + 2.0
    rows: list[tuple[float, ...]] = [
        (*_varied(_CONCRETE if concrete else look.asphalt, rng, 0.05, tone), worn),
        (*_varied(look.verge, rng, 0.1, rng.uniform(0.85, 1.15)), grassy),
        (*_varied(look.grass, rng, 0.2, rng.uniform(0.75, 1.25)), max(sea, -1e6)),
        (*_varied(look.dry, rng, 0.15, rng.uniform(0.75, 1.2)), 0.0),
        (*_varied(look.soil, rng, 0.12, 1.0), 0.0 if road.track.surface == "gravel" else worn),
        (*_varied(_LINE[marks.left_colour], rng, 0.03, fade), marks.line_width / 2),
        (*_varied(_LINE["white"], rng, 0.03, fade), marks.wear),
        (float(road.lanes), road.lane_width, road.half_asphalt, paved_to),
        (marks.dash_length, marks.dash_length + marks.dash_gap, missing, road.track.length_m),
        (mask.along_m, shade.TEXEL_M, float(shade.BAND_TEXELS), float(mask.strip.shape[0])),
    ]
    return np.array(rows, dtype=np.float32)


def _varied(colour: Colour, rng: np.random.Generator, tint: float, tone: float) -> list[float]:
    return [float(c * tone * (1.0 + rng.uniform(-tint, tint))) for c in colour]
