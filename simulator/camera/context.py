"""The one OpenGL context of a process: EGL without a window, on a GPU or on Mesa's llvmpipe.

On llvmpipe the environment variable LP_NUM_THREADS, read by Mesa when the context is made, sets
the drawing threads: 0 draws in the calling thread, which suits one worker process a core.
"""

import os
from dataclasses import dataclass
from importlib import resources
from typing import TYPE_CHECKING, Any

import numpy as np

from simulator.camera import foliage, textures
from simulator.camera.llvm import load_triton_first
from trackfeatures.errors import UserError

if TYPE_CHECKING:
    import moderngl

GPU_SAMPLES = 4
"""Samples a pixel on a GPU. On llvmpipe one: four took 24 ms a frame instead of 6, and road and
paint are filtered in the shader anyway."""
PROGRAMS = ("sky", "land", "road", "barrier", "prop", "tree", "car", "spot")
FRAME_BINDING, SCENE_BINDING = 0, 1
BLOCKS = {"Frame": FRAME_BINDING, "Scene": SCENE_BINDING}
FRAME_FLOATS = 56
UNITS = {"noise": 0, "shade": 1, "atlas": 2}
"""Texture units, by the name of the sampler."""
_KEPT_TARGETS = 8


class NoRendererError(UserError):
    """OpenGL through EGL is not to be had on this machine."""


@dataclass(frozen=True)
class Target:
    """Where a picture is drawn (multisampled) and where it is resolved for reading."""

    drawn: "moderngl.Framebuffer"
    resolved: "moderngl.Framebuffer"


class Graphics:
    """Context, programs and textures that every camera of the process shares."""

    def __init__(self) -> None:
        self.context = _create_context()
        self.programs = {name: self._program(name) for name in PROGRAMS}
        size = (textures.NOISE_SIZE, textures.NOISE_SIZE)
        self.noise = self.context.texture(size, 4, textures.noise_tile().tobytes())
        self.mipmapped(self.noise)
        # The nearest mipmap alone: noise shows no step, and a frame is drawn 1 ms sooner.
        self.noise.filter = (self.context.LINEAR_MIPMAP_NEAREST, self.context.LINEAR)
        sheet = foliage.atlas()
        self.atlas = self.context.texture(sheet.shape[1::-1], 4, sheet.tobytes())
        self.mipmapped(self.atlas)
        self.atlas.repeat_x = self.atlas.repeat_y = False
        corners = np.array([-1.0, -1.0, 3.0, -1.0, -1.0, 3.0], dtype=np.float32)
        buffer = self.context.buffer(corners.tobytes())
        self.sky = self.context.vertex_array(self.programs["sky"], [(buffer, "2f", "corner")])
        self.frame = self.context.buffer(reserve=FRAME_FLOATS * 4, dynamic=True)
        self._targets: dict[tuple[int, int], Target] = {}

    @property
    def renderer(self) -> str:
        """Name of what draws, such as "llvmpipe (LLVM 15.0.6, 256 bits)"."""
        return str(self.context.info["GL_RENDERER"])

    def target(self, width: int, height: int) -> Target:
        """The target of this size, made on first use; the few latest sizes are kept."""
        if (width, height) not in self._targets:
            if len(self._targets) >= _KEPT_TARGETS:
                self._release_oldest_target()
            self._targets[width, height] = self._make_target(width, height)
        return self._targets[width, height]

    def begin(self, target: Target) -> None:
        """Clear `target` and make it the one that is drawn to."""
        target.drawn.use()
        target.drawn.clear()
        self.context.enable_only(self.context.DEPTH_TEST)
        self.noise.use(UNITS["noise"])
        self.atlas.use(UNITS["atlas"])

    def blend(self) -> None:
        """From here on lay pictures with alpha over what is drawn, and leave the depth alone."""
        self.context.enable(self.context.BLEND)
        self.context.blend_func = (self.context.SRC_ALPHA, self.context.ONE_MINUS_SRC_ALPHA)

    def _make_target(self, width: int, height: int) -> Target:
        import moderngl

        size = (width, height)
        samples = 0 if "llvmpipe" in self.renderer else min(GPU_SAMPLES, self.context.max_samples)
        try:
            drawn = self.context.framebuffer(
                [self.context.renderbuffer(size, 4, samples=samples)],
                self.context.depth_renderbuffer(size, samples=samples),
            )
            resolved = drawn
            if samples:
                resolved = self.context.framebuffer([self.context.renderbuffer(size, 4)])
        except moderngl.Error as error:
            raise UserError(f"cannot draw pictures of {width} x {height}: {error}") from error
        return Target(drawn, resolved)

    def _release_oldest_target(self) -> None:
        oldest = self._targets.pop(next(iter(self._targets)))
        for framebuffer in (oldest.drawn, oldest.resolved):
            for attachment in framebuffer.color_attachments:
                attachment.release()
            if framebuffer.depth_attachment is not None:
                framebuffer.depth_attachment.release()
            framebuffer.release()

    def uniform(self, program: str, name: str) -> "moderngl.Uniform":
        """A plain uniform of one of the programs."""
        import moderngl

        member = self.programs[program][name]
        if not isinstance(member, moderngl.Uniform):
            raise TypeError(f"{name} of program {program} is no uniform")
        return member

    def _program(self, name: str) -> "moderngl.Program":
        import moderngl

        head = "#version 330 core\n" + _source("frame.glsl")
        program = self.context.program(
            vertex_shader=head + _source(f"{name}.vert.glsl"),
            fragment_shader=head + _source(f"{name}.frag.glsl"),
        )
        for key in program:
            member = program[key]
            if isinstance(member, moderngl.UniformBlock):
                member.binding = BLOCKS[key]
            elif isinstance(member, moderngl.Uniform) and key in UNITS:
                member.value = UNITS[key]
        return program

    def mipmapped(self, texture: "moderngl.Texture") -> None:
        """Build the texture's mipmaps and let it be filtered through them."""
        texture.build_mipmaps()
        texture.filter = (self.context.LINEAR_MIPMAP_LINEAR, self.context.LINEAR)


_shared: dict[int, Graphics] = {}


def graphics() -> Graphics:
    """This process's graphics, made on first use. Raises NoRendererError without EGL."""
    # A forked child must not use its parent's context, hence the process id.
    process = os.getpid()
    if process not in _shared:
        _shared.clear()
        _shared[process] = Graphics()
    return _shared[process]


def _source(name: str) -> str:
    return (resources.files("simulator.camera") / "shaders" / name).read_text()


def _create_context() -> "moderngl.Context":
    import moderngl

    settings: dict[str, Any] = {"backend": "egl"}
    load_triton_first()
    try:
        return moderngl.create_context(require=330, standalone=True, **settings)
    except Exception as error:  # moderngl and glcontext raise bare Exception, ImportError, ...
        raise NoRendererError(
            f"no OpenGL 3.3 through EGL on this machine ({error}); "
            "install it with: apt-get install libegl1 libgl1-mesa-dri"
        ) from error
