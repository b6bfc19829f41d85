"""Everything that stands still in one round: road, land, and their colours."""

import numpy as np
from numpy.typing import NDArray

from simulator.camera import barriers, land, props, ribbon, scenery, shade
from simulator.camera.context import SCENE_BINDING, Graphics
from simulator.camera.light import Light
from simulator.camera.look import Colour, Look, look_of
from simulator.camera.mesh import Mesh
from simulator.camera.terrain import CentreLine
from simulator.camera.terrain import build as build_terrain
from simulator.camera.woods import Woods
from simulator.track.road import Road

FloatArray = NDArray[np.float64]

FINE_LAND_M, COARSE_LAND_M = 260.0, 2500.0
PROPS_M = 350.0
BARRIER_M = (60.0, 300.0)
FINE_ROAD_M, COARSE_ROAD_M = 90.0, 650.0
_LINE = {"white": (0.78, 0.78, 0.75), "yellow": (0.75, 0.50, 0.06)}


class Scene:
    """The still world of one road and seed; `draw` paints it with the frame that is set."""

    def __init__(self, graphics: Graphics, road: Road, seed: int, light: Light) -> None:
        look = look_of(road.track.look)
        line = CentreLine.of(road)
        terrain = build_terrain(road, line, look, np.random.default_rng([seed, 1]))
        strips = ribbon.build(road, line, terrain)
        self._graphics = graphics
        self._road = Mesh(
            graphics,
            "road",
            ribbon.surface(strips, road),
            ("3f 2f 3f 1f", "at", "road", "facing", "kerbed"),
        )
        layout = ("3f 3f", "at", "facing")
        self._land = Mesh(graphics, "land", land.fine(terrain), layout)
        self._far_land = Mesh(graphics, "land", land.coarse(terrain), layout)
        self._barriers = Mesh(
            graphics,
            "barrier",
            barriers.build(road, strips, look, np.random.default_rng([seed, 5])),
            ("3f 2f 1f 3f", "at", "along", "kind", "facing"),
        )
        self._props = Mesh(
            graphics,
            "prop",
            props.build(road, line, strips, terrain, look, np.random.default_rng([seed, 6])),
            ("3f 3f 3f 3f", "at", "facing", "colour", "surface"),
        )
        trees = scenery.plant(road, line, strips, terrain, look, np.random.default_rng([seed, 3]))
        self.mask = shade.build(road, line, trees, light, np.random.default_rng([seed, 4]))
        self._woods = Woods(graphics, trees)
        palette = scene_block(road, look, np.random.default_rng([seed, 2]), self.mask)
        self._block = graphics.context.buffer(palette.tobytes())
        self._shade = graphics.context.texture(
            self.mask.texels.shape[::-1], 1, self.mask.texels.tobytes()
        )
        graphics.mipmapped(self._shade)

    def draw(self, eye: FloatArray, planes: FloatArray) -> None:
        """Paint everything but the sky; nearest first, so that hidden pixels cost little."""
        self._block.bind_to_uniform_block(SCENE_BINDING)
        self._shade.use(1)
        self._road.draw(eye, planes, FINE_ROAD_M, COARSE_ROAD_M)
        self._props.draw(eye, planes, PROPS_M)
        self._land.draw(eye, planes, FINE_LAND_M)
        self._far_land.draw(eye, planes, COARSE_LAND_M)

    def draw_blended(self, eye: FloatArray, planes: FloatArray) -> None:
        """Paint what lets light through, after all else."""
        self._barriers.draw(eye, planes, *BARRIER_M)
        self._woods.draw(eye, planes)

    def release(self) -> None:
        """Free the graphics memory."""
        for thing in (
            self._road,
            self._land,
            self._far_land,
            self._barriers,
            self._props,
            self._woods,
            self._block,
            self._shade,
        ):
            thing.release()


def scene_block(
    road: Road, look: Look, rng: np.random.Generator, mask: shade.ShadeMask
) -> NDArray[np.float32]:
    """The uniform block `Scene` of frame.glsl, (10, 4) float32."""
    marks = road.track.markings
    tone = rng.uniform(0.72, 1.35)
    worn = float(np.clip(look.worn * rng.uniform(0.4, 1.5), 0.0, 1.0))
    missing = float(rng.choice([0.0, 0.05, 0.12], p=[0.5, 0.3, 0.2])) if marks.wear > 0.0 else 0.0
    grassy = float(np.clip(rng.normal(0.35, 0.3), 0.0, 1.0))
    fade = rng.uniform(0.8, 1.05)
    rows: list[tuple[float, ...]] = [
        (*_varied(look.asphalt, rng, 0.05, tone), worn),
        (*_varied(look.verge, rng, 0.1, rng.uniform(0.85, 1.15)), grassy),
        (*_varied(look.grass, rng, 0.2, rng.uniform(0.75, 1.25)), 0.0),
        (*_varied(look.dry, rng, 0.15, rng.uniform(0.75, 1.2)), 0.0),
        (*_varied(look.soil, rng, 0.12, 1.0), 0.0 if road.track.surface == "gravel" else worn),
        (*_varied(_LINE[marks.left_colour], rng, 0.03, fade), marks.line_width / 2),
        (*_varied(_LINE["white"], rng, 0.03, fade), marks.wear),
        (float(road.lanes), road.lane_width, road.half_asphalt, road.edge),
        (marks.dash_length, marks.dash_length + marks.dash_gap, missing, road.track.length_m),
        (mask.along_m, shade.TEXEL_M, float(shade.BAND_TEXELS), float(mask.bands)),
    ]
    return np.array(rows, dtype=np.float32)


def _varied(colour: Colour, rng: np.random.Generator, tint: float, tone: float) -> list[float]:
    return [float(c * tone * (1.0 + rng.uniform(-tint, tint))) for c in colour]
