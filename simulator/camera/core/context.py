"""Creates the single OpenGL context of a process: EGL without a window, on a GPU or on llvmpipe.

Every thread may draw, but only one thread draws at a time (see `turns`).

llvmpipe is Mesa's software renderer. When the context is created, it reads its number of drawing
threads from the environment variable LP_NUM_THREADS. With 0 it draws in the calling thread, which
suits one worker process per core.
"""

import atexit
import ctypes
import importlib.util
import os
import sys
import threading
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from simulator.camera.core.render_modes import CLASSES
from simulator.camera.core.targets import GPU_SAMPLES, Target, Targets
from simulator.camera.core.turns import FORKED, Egl, ForkedRendererError, Turns
from simulator.camera.vegetation import foliage
from trackfeatures.errors import UserError

if TYPE_CHECKING:
    import moderngl

PROGRAMS = (
    "sky",
    "dome",
    "land",
    "paved",
    "verge",
    "barrier",
    "prop",
    "tree",
    "car",
    "spot",
    "precipitation",
)
FRAME_BINDING, SCENE_BINDING, LOOK_BINDING = 0, 1, 2
VERTEX_SHADERS = {"paved": "road", "verge": "road"}
"""Programs without a vertex shader of their own, each with the program whose shader it uses."""
LIBRARIES = ("output.glsl", "weather.glsl", "road.glsl", "sea.glsl")
"""Shader files with functions that fragment shaders call."""
BLOCKS = {"Frame": FRAME_BINDING, "Scene": SCENE_BINDING, "Look": LOOK_BINDING}
VARIED = "varied"
"""Feature of the programs for varied roads; they read the uniform block `Look` of look.glsl."""
NIGHT = "night"
"""Feature of the programs for night scenes; they include the lighting of night.glsl."""
VARIED_LIBRARIES = ("paint.glsl", "surface.glsl")
"""Shader files with functions that only the fragment shaders of varied roads call."""
WEATHER_PROGRAMS = ("sky", "land", "paved", "verge", "barrier", "prop", "tree")
"""Programs with variants for rain and snow; dry scenes use the faster variant without them."""
FRAME_FLOATS = 56
NOISE_SIZE = 256
NOISE_UNIT, SHADOW_UNIT, ATLAS_UNIT, SKY_UNIT = range(4)
UNITS = {"noise": NOISE_UNIT, "shade": SHADOW_UNIT, "atlas": ATLAS_UNIT, "panorama": SKY_UNIT}
"""Texture units, by the name of the sampler."""


class NoRendererError(UserError):
    """Raised if OpenGL through EGL is not available on this machine."""


class Graphics:
    """The context, programs and textures that all cameras of the process share.

    Everything except `turns` may only be used inside a `with` block of `turns`.
    """

    def __init__(self) -> None:
        self.context, self.turns = _create_context()
        with self.turns:
            self._fill()

    def _fill(self) -> None:
        """Compile the programs, and create the shared textures, buffers and targets."""
        self.renderer = str(self.context.info["GL_RENDERER"])
        """Name of the OpenGL renderer, such as "llvmpipe (LLVM 15.0.6, 256 bits)"."""
        self.programs = {name: self._program(name) for name in PROGRAMS}
        self.noise = self.texture(noise_tile())
        self.atlas = self.texture(foliage.atlas())
        self.atlas.repeat_x = self.atlas.repeat_y = False
        self.frame = self.context.buffer(reserve=FRAME_FLOATS * 4, dynamic=True)
        samples = 0 if "llvmpipe" in self.renderer else min(GPU_SAMPLES, self.context.max_samples)
        self.targets = Targets(self.context, samples)

    def begin(self, target: Target, labels: bool = False) -> None:
        """Clear `target`, bind it for drawing, and bind the shared textures. `labels` is True for a
        target of depth and class, False for a target of colours."""
        target.clear(labels)
        self.context.enable_only(self.context.DEPTH_TEST)
        self.use_textures()

    def use_textures(self) -> None:
        """Bind the textures that all scenes share."""
        self.noise.use(NOISE_UNIT)
        self.atlas.use(ATLAS_UNIT)

    def blend(self) -> None:
        """Enable alpha blending for all later draw calls."""
        self.context.enable(self.context.BLEND)
        self.context.blend_func = (self.context.SRC_ALPHA, self.context.ONE_MINUS_SRC_ALPHA)

    def uniform(self, program: str, name: str) -> "moderngl.Uniform":
        """Return the uniform `name` of `program`, a key of `programs`. Raises TypeError if the
        program's member `name` is not a uniform."""
        import moderngl

        member = self.programs[program][name]
        if not isinstance(member, moderngl.Uniform):
            raise TypeError(f"{name} of program {program} is no uniform")
        return member

    def weather_program(self, name: str, weather: str, *features: str) -> str:
        """Return the key in `programs` of the variant of program `name` for `weather` ("" when dry)
        and `features`; compile it on first use. The shaders test the features by #ifdef, such as
        "sea" for land with a shore."""
        defines = [*features, *([weather] if weather and name in WEATHER_PROGRAMS else [])]
        key = " ".join([name, *defines])
        if key not in self.programs:
            self.programs[key] = self._program(name, *defines)
        return key

    def label_program(self, name: str) -> str:
        """Return the key in `programs` of the program that draws the same geometry as program
        `name`, but depth and class of each pixel instead of colours; compile it on first use."""
        program, *features = name.split()
        kept = [VARIED] if VARIED in features else []
        key = " ".join([program, *kept, "labels"])
        if key not in self.programs:
            self.programs[key] = self._program(program, *kept, "labels")
        return key

    def _program(self, name: str, *defines: str) -> "moderngl.Program":
        """Compile a program with the #defines `defines`, and bind its blocks and samplers."""
        import moderngl

        head = "#version 330 core\n"
        for define in defines:
            head += f"#define {define.upper()}\n"
        head += _source("frame.glsl")
        varied = VARIED in defines
        if varied:
            head += _source("look.glsl")
        if NIGHT in defines:
            head += _source("night.glsl")
        classes = "".join(f"#define {name.upper()} {k}\n" for k, name in enumerate(CLASSES))
        libraries = "".join(
            _source(library) for library in (*LIBRARIES, *VARIED_LIBRARIES * varied)
        )
        program = self.context.program(
            vertex_shader=head + _source(f"{VERTEX_SHADERS.get(name, name)}.vert.glsl"),
            fragment_shader=head + classes + libraries + _source(f"{name}.frag.glsl"),
        )
        for key in program:
            member = program[key]
            if isinstance(member, moderngl.UniformBlock):
                member.binding = BLOCKS[key]
            elif isinstance(member, moderngl.Uniform) and key in UNITS:
                member.value = UNITS[key]
        return program

    def texture(self, texels: NDArray[np.uint8]) -> "moderngl.Texture":
        """Create a texture with mipmaps from `texels`, (rows, columns) or (rows, columns,
        components)."""
        components = texels.shape[2] if texels.ndim == 3 else 1
        texture = self.context.texture(texels.shape[1::-1], components, texels.tobytes())
        texture.build_mipmaps()
        # Reading only the nearest mipmap level saves 1 ms per frame. Noise in the textures hides
        # the steps between the levels.
        texture.filter = (self.context.LINEAR_MIPMAP_NEAREST, self.context.LINEAR)
        return texture

    def free_unused(self) -> None:
        """Free the graphics memory of all objects that have no references any more."""
        self.context.gc()


_shared: dict[int, Graphics] = {}
_begun: set[int] = set()
"""Ids of this process and of the processes it was forked from that have created a context."""
_making = [threading.Lock()]


def graphics() -> Graphics:
    """Return the graphics of this process, created at the first call.

    Raises NoRendererError without EGL, and ForkedRendererError in a process that was forked from
    one with graphics: Mesa's drawing threads do not exist in a forked process, so drawing would
    never return.
    """
    process = os.getpid()
    if process not in _shared:
        with _making[0]:
            if process not in _shared:
                _make(process)
    return _shared[process]


def _make(process: int) -> None:
    """Create and store the graphics of `process`. Raises ForkedRendererError if it was forked."""
    if _begun - {process}:
        raise ForkedRendererError(FORKED)
    _begun.add(process)
    try:
        made = Graphics()
    except NoRendererError:
        _begun.discard(process)
        raise
    atexit.register(made.turns.end)
    _shared[process] = made


def _renew_lock() -> None:
    """Replace the lock in a forked child, because a thread of the parent may have held it."""
    _making[0] = threading.Lock()


os.register_at_fork(after_in_child=_renew_lock)


def _source(name: str) -> str:
    return (resources.files("simulator.camera") / "shaders" / name).read_text()


def _create_context() -> "tuple[moderngl.Context, Turns]":
    """Create a context and its turns; the context that was current here becomes current again."""
    import moderngl

    settings: dict[str, Any] = {"backend": "egl"}
    _load_triton_first()
    try:
        egl = Egl()
        before = egl.current()
        context = moderngl.create_context(require=330, standalone=True, **settings)
    except Exception as error:  # moderngl and glcontext raise bare Exception, ImportError, ...
        raise NoRendererError(
            f"no OpenGL 3.3 through EGL on this machine ({error}); "
            "install it with: apt-get install libegl1 libgl1 libgl1-mesa-dri"
        ) from error
    # Objects that Python drops are queued and freed in a turn: the garbage collector can run in a
    # thread, or a forked child, that must not call OpenGL.
    context.gc_mode = "context_gc"
    own = egl.current()
    egl.give_back(own, before)
    return context, Turns(egl, own, free=context.gc)


def _load_triton_first() -> None:
    """Load triton's library before Mesa's, if triton is installed (about 30 ms, no import).

    Mesa makes the symbols of its libLLVM global. If libtriton (part of torch's dependencies) is
    loaded after Mesa, it binds to Mesa's symbols and crashes at import. If libtriton is loaded
    first, it uses its own symbols. A process that draws can then import torch at any time.
    """
    if "triton" in sys.modules:
        return
    spec = importlib.util.find_spec("triton")
    if spec is None or not spec.submodule_search_locations:
        return
    for library in Path(spec.submodule_search_locations[0]).glob("_C/libtriton*.so"):
        ctypes.CDLL(str(library))


def noise_tile() -> NDArray[np.uint8]:
    """Return tileable noise (256, 256, 4) uint8. The channels are grain, fine patches, broad
    patches and crack lines, in the order R, G, B, A."""
    rng = np.random.default_rng(20240607)
    grain = _levelled(_filtered(rng, 0.35))
    fine = _levelled(_filtered(rng, 1.15))
    broad = _levelled(_filtered(rng, 1.7))
    ridges = 1.0 - np.abs(2.0 * _levelled(_filtered(rng, 1.45)) - 1.0)
    tile = np.stack([grain, fine, broad, ridges], axis=-1)
    return np.rint(tile * 255.0).astype(np.uint8)


def _filtered(rng: np.random.Generator, power: float) -> NDArray[np.float64]:
    """Return periodic noise whose amplitude is proportional to 1 / frequency^power."""
    frequency = np.hypot(*np.meshgrid(np.fft.fftfreq(NOISE_SIZE), np.fft.fftfreq(NOISE_SIZE)))
    frequency[0, 0] = 1.0
    weight = (frequency * NOISE_SIZE) ** -power
    weight[0, 0] = 0.0
    spectrum = np.fft.fft2(rng.standard_normal((NOISE_SIZE, NOISE_SIZE)))
    return np.asarray(np.fft.ifft2(spectrum * weight).real)


def _levelled(field: NDArray[np.float64]) -> NDArray[np.float64]:
    """Replace each value of `field` by its rank, scaled to 0 to 1."""
    rank = np.empty(field.size)
    rank[np.argsort(field, axis=None, kind="stable")] = np.linspace(0.0, 1.0, field.size)
    return rank.reshape(field.shape)
