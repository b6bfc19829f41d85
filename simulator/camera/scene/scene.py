"""The static scene of one round: road, terrain, bridges, trees, props, and their colours."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from simulator.arrays import FloatArray
from simulator.camera.bridges import bridges
from simulator.camera.core.context import (
    LOOK_BINDING,
    NIGHT,
    SCENE_BINDING,
    SHADOW_UNIT,
    VARIED,
    Graphics,
)
from simulator.camera.core.mesh import Mesh, Surface
from simulator.camera.core.optics import Eye
from simulator.camera.scene import barriers, land, props, road_mesh, shadow_mask
from simulator.camera.scene.light import Light
from simulator.camera.scene.look_block import LINE_COLOURS, look_block, surface_features
from simulator.camera.scene.roadside import parked_cars, seen_road, seen_theme
from simulator.camera.scene.terrain import COARSEST, Survey
from simulator.camera.scene.terrain import build as build_terrain
from simulator.camera.scene.themes import Colour, Theme, find_theme
from simulator.camera.vegetation import scenery
from simulator.camera.vegetation.trees import TreeMesh, VisibleTrees
from simulator.track.road import Road
from simulator.varied.look import RoadLook, Roadside

LAND = (
    land.Span(1, 0.0, 40.0, bare=False),
    land.Span(2, 40.0, 120.0, bare=False),
    land.Span(4, 120.0, 350.0, bare=True),
    land.Span(COARSEST, 350.0, 2500.0, bare=True),
)
_CONCRETE: Colour = (0.21, 0.205, 0.19)


@dataclass(frozen=True)
class VisibleScene:
    """The part of a scene visible from one eye: index runs of its meshes, and its trees."""

    solid: tuple[tuple[Mesh, list[list[int]]], ...]
    barriers: list[list[int]]
    trees: VisibleTrees


class Scene:
    """The static scene of one road, seed and light. `draw` requires that the uniform block `Frame`
    is bound."""

    def __init__(
        self,
        graphics: Graphics,
        road: Road,
        survey: Survey,
        seed: int,
        light: Light,
        look: RoadLook | None = None,
    ) -> None:
        def rng(part: int) -> np.random.Generator:
            return np.random.default_rng([seed, part])

        road = seen_road(road, look)
        theme = seen_theme(find_theme(road.track.look), look)
        terrain = build_terrain(road, survey, theme, rng(1))
        ground = road_mesh.Ground.of(road, survey.line, terrain)
        scene_bridges = bridges.build(ground, theme, rng(8))
        roadside = look.roadside if look else Roadside()
        trees = scenery.plant(
            ground, theme, scene_bridges, rng(3), avenue=light.canopy, tunnel=roadside.tunnel
        )
        tree_shade = land.TreeShade.of(terrain, survey.line, trees, light)
        rails = barriers.build(road, ground.mesh, theme, rng(5), roadside)
        lamps = look.light.lamp_every_m if look and look.light.night else 0.0
        built = props.build(ground, theme, scene_bridges, rng(6), lamps)
        covered = road_mesh.covers(ground.mesh, survey, margin_m=2.0)
        self.mask = shadow_mask.build(
            road, trees, scene_bridges, tree_shade, light, rng(4), sky=look is not None
        )
        night = [NIGHT] if look and look.light.night else []
        self.bridges = scene_bridges
        self.parked = parked_cars(road, roadside.parked_every_m, rng(9))
        self._trees = TreeMesh(graphics, trees, light.weather, *night)

        def mesh(program: str, surface: Surface, layout: Sequence[str], *features: str) -> Mesh:
            variant = graphics.weather_program(program, light.weather, *features, *night)
            return Mesh(graphics, variant, surface, layout)

        varied = [VARIED] if look else []
        features = {"paved": surface_features(look.surface) if look else (), "verge": ()}
        surfaces = road_mesh.surfaces(ground.mesh, road)
        lands = [land.surface(tree_shade, covered, span) for span in LAND]
        self._barriers = mesh("barrier", rails, barriers.LAYOUT, *varied)
        self._solid = (
            *(
                mesh(name, each, road_mesh.LAYOUT, *varied, *features[name])
                for name, each in surfaces.items()
            ),
            *(mesh("prop", each, props.LAYOUT, name) for name, each in built.items()),
            *(mesh("land", each, land.LAYOUT, *(["sea"] if theme.sea else [])) for each in lands),
        )
        palette = scene_block(road, theme, rng(2), self.mask, terrain.sea)
        if look and look.surface.tone:
            warm = look.surface.warmth
            palette[0, :3] = look.surface.tone * np.array([1.0 + warm / 2, 1.0, 1.0 - warm / 2])
        self._block = graphics.context.buffer(palette.tobytes())
        self._look = graphics.context.buffer(look_block(road, look).tobytes()) if look else None
        self._shadow_texture = graphics.texture(self.mask.texels)

    def visible(self, eye: Eye, planes: FloatArray) -> VisibleScene:
        """Return the parts visible from `eye`. `planes` (4, 3) are the inward normals of the side
        planes of the view."""
        return VisibleScene(
            tuple((mesh, mesh.visible(eye.place, planes)) for mesh in self._solid),
            self._barriers.visible(eye.place, planes),
            self._trees.visible(eye.place, planes, from_above=eye.axes[2, 2] < -0.9),
        )

    def draw(self, seen: VisibleScene, labels: bool) -> None:
        """Draw all opaque parts of `seen` except the sky, as depth and class if `labels`, else as
        colours. Parts that are usually near are drawn first, because the depth test then skips
        hidden pixels."""
        self._block.bind_to_uniform_block(SCENE_BINDING)
        if self._look is not None:
            self._look.bind_to_uniform_block(LOOK_BINDING)
        self._shadow_texture.use(SHADOW_UNIT)
        self._trees.draw(seen.trees, "labels" if labels else "core")
        for mesh, runs in seen.solid:
            mesh.draw(runs, labels)
        if labels:
            self._barriers.draw(seen.barriers, labels)

    def draw_blended(self, seen: VisibleScene) -> None:
        """Draw the transparent parts of `seen`. Call this after all opaque parts are drawn."""
        self._barriers.draw(seen.barriers, labels=False)
        self._trees.draw(seen.trees, "fringe")


def scene_block(
    road: Road, theme: Theme, rng: np.random.Generator, mask: shadow_mask.ShadowMask, sea: float
) -> NDArray[np.float32]:
    """Return the uniform block `Scene` of frame.glsl, (10, 4) float32: the colours of `theme`,
    varied at random by `rng`, the lanes and paint of `road`, the layout of the shadow `mask`, and
    the sea level `sea` (m)."""
    marks, concrete = road.track.markings, road.track.surface == "concrete"
    tone = rng.uniform(0.72, 1.35)
    worn = float(np.clip(theme.worn * rng.uniform(0.4, 1.5), 0.0, 1.0))
    missing = float(rng.choice([0.0, 0.05, 0.12], p=[0.5, 0.3, 0.2])) if marks.wear > 0.0 else 0.0
    grassy = float(np.clip(rng.normal(theme.grassy, 0.3 * min(1.0, 3.0 * theme.grassy)), 0.0, 1.0))
    fade = rng.uniform(0.8, 1.05)
    # Without grass the pavement reaches beyond the wall line.
    paved_to = road.edge if theme.grassy > 0.0 else road.wall_offset + 2.0
    rows: list[tuple[float, ...]] = [
        (*_jitter(_CONCRETE if concrete else theme.asphalt, rng, 0.05, tone), worn),
        (*_jitter(theme.verge, rng, 0.1, rng.uniform(0.85, 1.15)), grassy),
        (*_jitter(theme.grass, rng, 0.2, rng.uniform(0.75, 1.25)), max(sea, -1e6)),
        (*_jitter(theme.dry, rng, 0.15, rng.uniform(0.75, 1.2)), 0.0),
        (*_jitter(theme.soil, rng, 0.12, 1.0), 0.0 if road.track.surface == "gravel" else worn),
        (*_jitter(LINE_COLOURS[marks.left_colour], rng, 0.03, fade), marks.line_width / 2),
        (*_jitter(LINE_COLOURS["white"], rng, 0.03, fade), marks.wear),
        (float(road.lanes), road.lane_width, road.half_asphalt, paved_to),
        (marks.dash_length, marks.dash_length + marks.dash_gap, missing, road.track.length_m),
        (
            mask.along_m,
            shadow_mask.TEXEL_M,
            float(shadow_mask.BAND_TEXELS),
            float(mask.strip.shape[0]),
        ),
    ]
    return np.array(rows, dtype=np.float32)


def _jitter(colour: Colour, rng: np.random.Generator, tint: float, tone: float) -> list[float]:
    return [float(c * tone * (1.0 + rng.uniform(-tint, tint))) for c in colour]
