"""Inference engines: OpenVINO by default, torch in float32 as the reference.

An engine takes one camera image, uint8 RGB; normalisation is part of the graph. torch is imported
only when the torch engine is requested, because the service's container does not have torch.
"""

import json
import os
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from threading import Lock
from typing import Any, Literal, Protocol, cast, get_args

import numpy as np
from numpy.typing import NDArray

from mtlnet.inference.model_card import (
    GRAPH,
    GRAPH_WEIGHTS,
    ModelCard,
    ModelError,
    check_files,
    read_card,
)
from mtlnet.inference.view_average import Views, mean_outputs
from runtime.files import file_hash, utf8_path
from runtime.processor import has_int8

EngineKind = Literal["openvino", "torch"]
Precision = Literal["bf16", "f32", "int8"]
EXPORT_FILE = "export.json"
INT8 = Path("export") / "openvino-int8"
GATES = ("gate", "other_gate")
"""Keys in the `export.json` of an int8 graph: the accuracy gate evaluated by the export, and later
on a processor of the other kind, with or without native int8 (`mtlnet export --gate-only`)."""


class Engine(Protocol):
    """Interface of a loaded model; an engine must not be shared between threads."""

    @property
    def card(self) -> ModelCard:
        """Card of the model."""

    @property
    def kind(self) -> str:
        """Library that computes: "openvino" or "torch"."""

    @property
    def precision(self) -> str:
        """Precision of the computation: "f32", "bf16" or "int8"."""

    def __call__(self, image: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Return the outputs (K,) for an RGB image (H, W, 3) of the size of `card.camera`.

        `mtlnet.inference.prediction.split_outputs` explains the K numbers, `decode_outputs`
        converts them to metres and radians. Raises ModelError for an image of another size or type.
        """


def load_engine(
    run: Path,
    kind: EngineKind = "openvino",
    precision: Precision | None = None,
    threads: int = 1,
    *,
    gpu: bool = False,
    views: int = 1,
) -> Engine:
    """Load the model in folder `run`, which `mtlnet.inference.model_card.resolve_run` finds by
    name.

    `precision` None selects `default_precision` for OpenVINO. The torch engine supports only
    float32; with `gpu` it computes on a GPU if there is one. `threads`: number of CPU threads for
    one image. `views`: number of views of each image whose outputs are averaged, 1, 2 or 6; the
    time is proportional to this number. Raises ModelError when the model is missing, unfinished or
    damaged.
    """
    card = read_card(run)
    engine = _load_plain(run, card, kind, precision, threads, gpu=gpu)
    return engine if views == 1 else ViewAverage(engine, views)


def _load_plain(
    run: Path,
    card: ModelCard,
    kind: EngineKind,
    precision: Precision | None,
    threads: int,
    *,
    gpu: bool,
) -> Engine:
    if kind == "torch":
        if precision not in (None, "f32"):
            raise ModelError(
                f"the torch engine computes in float32 only, not in {precision}; choose precision "
                "f32 or the openvino engine"
            )
        from mtlnet.inference.torch_engine import TorchEngine

        return TorchEngine(run, card, threads, gpu=gpu)
    return OpenVinoEngine(run, card, precision, threads)


class ViewAverage:
    """An engine that averages the outputs of `plain` for `count` views of each image
    (`mtlnet.inference.view_average`)."""

    def __init__(self, plain: Engine, count: int) -> None:
        self.plain = plain
        self.card, self.kind, self.precision = plain.card, plain.kind, plain.precision
        self.on_gpu = bool(getattr(plain, "on_gpu", False))
        self.views = Views(count, plain.card.camera)

    def __call__(self, image: NDArray[np.uint8]) -> NDArray[np.float32]:
        self.card.check_image(image)
        outputs = np.stack([self.plain(view) for view in self.views.of(image)])
        mean: NDArray[np.float32] = mean_outputs(outputs[:, None])[0]
        return mean

    def batch(self, images: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Compute the outputs (B, K) for uint8 images (B, H, W, 3) with the torch engine."""
        views = zip(*map(self.views.of, images), strict=True)
        found = [self.plain.batch(np.stack(view)) for view in views]  # type: ignore[attr-defined]
        return mean_outputs(np.stack(found))


def int8_files(engine: Engine) -> dict[str, str]:
    """Return the SHA-256 hashes of the files of the int8 graph with which `engine` computes, by
    name; empty for another precision."""
    plain = engine.plain if isinstance(engine, ViewAverage) else engine
    return dict(getattr(plain, "int8_files", {}))


def view_count(engine: Engine) -> int:
    """Return the number of views of each image whose outputs `engine` averages."""
    return engine.views.count if isinstance(engine, ViewAverage) else 1


class OpenVinoEngine:
    """The model's OpenVINO graph, compiled for this CPU."""

    kind = "openvino"

    def __init__(
        self, run: Path, card: ModelCard, precision: Precision | None = None, threads: int = 1
    ) -> None:
        import openvino

        self.card = card
        best = best_precision()
        self.precision: Precision = precision or default_precision(run, card)
        if self.precision == "bf16":
            self.precision = best  # without bf16 in the processor OpenVINO computes in float32
        quantised = self.precision == "int8"
        export = read_export(run / INT8) if quantised else None
        self.int8_files: dict[str, str] = {} if export is None else export["files"]
        options = {
            "INFERENCE_PRECISION_HINT": best if quantised else self.precision,
            "INFERENCE_NUM_THREADS": threads,
            "NUM_STREAMS": 1,
            # With pinning, two worker processes would choose the same core.
            "ENABLE_CPU_PINNING": False,
        }
        try:
            graph = int8_graph(run, card) if quantised else None
            model = read_graph(run, card) if graph is None else _read_model(graph)
            compiled = openvino_core().compile_model(model, "CPU", options)
        except RuntimeError as error:
            reason = str(error).strip().splitlines()[-1]
            raise ModelError(f"OpenVINO cannot load the graph of {run}: {reason}") from error
        self._request = compiled.create_infer_request()
        self._input: NDArray[np.uint8] = np.empty(tuple(compiled.input(0).shape), np.uint8)
        self._request.set_input_tensor(0, openvino.Tensor(self._input, shared_memory=True))
        self._output: NDArray[np.float32] = self._request.get_output_tensor(0).data

    def __call__(self, image: NDArray[np.uint8]) -> NDArray[np.float32]:
        self.card.check_image(image)
        self._input[0] = image
        self._request.infer()
        outputs: NDArray[np.float32] = self._output[0].copy()
        return outputs


def _read_model(graph: Path) -> Any:
    """Read the OpenVINO model in a file. Raises RuntimeError when OpenVINO cannot read it."""
    with utf8_path(graph) as plain:
        return openvino_core().read_model(str(plain))


def read_graph(run: Path, card: ModelCard) -> Any:
    """Read the OpenVINO model of a run from its stored graph. A run written without OpenVINO or by
    an earlier `mtlnet ship` has no graph; then its weights are converted, which requires torch.

    Raises ModelError when a file is missing or damaged, RuntimeError when OpenVINO cannot read it.
    """
    if GRAPH in card.files:
        check_files(run, card, (GRAPH, GRAPH_WEIGHTS))
        return _read_model(run / GRAPH)
    if find_spec("torch") is None:
        raise ModelError(
            f"{run} has no graph ({GRAPH}): it was written without OpenVINO or by an earlier "
            f"`mtlnet ship`; `mtlnet ship --model {run} --out FOLDER` writes a model with a graph, "
            "where torch and OpenVINO are installed"
        )
    from mtlnet.inference.torch_engine import convert_run

    return convert_run(run, card)


def run_graph(
    graph: Any, precision: str, images: NDArray[np.uint8], batch: int = 1
) -> NDArray[np.float32]:
    """Compute the outputs (N, K) of an OpenVINO model for uint8 images (N, 210, 280, 3).

    `graph`: an `openvino.Model` or the path of its file; `precision`: "f32" or "bf16"; `batch`:
    images per inference. `mtlnet.inference.prediction.split_outputs` explains the K columns. Raises
    RuntimeError when OpenVINO cannot load the model.
    """
    options = {"INFERENCE_PRECISION_HINT": precision, "NUM_STREAMS": 1}
    source = str(graph) if isinstance(graph, Path) else graph
    request = openvino_core().compile_model(source, "CPU", options).create_infer_request()
    parts = (images[first : first + batch] for first in range(0, len(images), batch))
    return np.concatenate([request.infer([part])[0].copy() for part in parts])


# Exports of a run. The folder of each export has an `export.json`, written by `mtlnet export`.


def read_export(folder: Path) -> dict[str, Any] | None:
    """Read the `export.json` of a folder; None if the file does not exist. Raises ModelError when
    it is damaged."""
    path = folder / EXPORT_FILE
    if not path.is_file():
        return None
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        if not isinstance(content["files"], dict) or "model_hash" not in content:
            raise TypeError("no files or no model_hash")
    except (ValueError, KeyError, TypeError) as error:
        raise ModelError(f"{path} is damaged ({error!r}); delete it or export again") from error
    return dict(content)


def uses_int8(run: Path, card: ModelCard) -> bool:
    """Return whether int8 is the default precision of a run on this processor.

    True if the run has an int8 graph of the card's weights that passed its accuracy gate
    (`mtlnet.export.int8`) on this kind of processor. The kinds are with and without native int8; a
    processor without native int8 can round sums differently. A graph that was only evaluated
    without native int8 is also used with native int8.
    """
    about = read_export(run / INT8)
    if about is None or about["model_hash"] != card.model_hash:
        return False
    native = has_int8()
    gates = [about[key] for key in GATES if about.get(key)]
    same = [gate for gate in gates if gate.get("native_int8", False) == native]
    judges = same or [gate for gate in gates if native]
    return bool(judges) and all(gate.get("passed") for gate in judges)


def default_precision(run: Path, card: ModelCard) -> Precision:
    """Return the precision in which OpenVINO computes the run's model by default on this processor:
    int8 if the model has an int8 graph that passed its accuracy gate and is reliable here
    (`uses_int8`), else bf16 if the processor supports it, else float32."""
    return "int8" if uses_int8(run, card) else best_precision()


def int8_graph(run: Path, card: ModelCard) -> Path:
    """Return the path of a run's int8 graph. Raises ModelError if a file of the graph is missing or
    damaged, or if the graph was made from other weights than the card's."""
    folder = run / INT8
    about = read_export(folder)
    how = f"make it with `mtlnet export --model {run} --format openvino --precision int8`"
    if about is None:
        raise ModelError(f"{run} has no int8 graph; {how}")
    if about["model_hash"] != card.model_hash:
        raise ModelError(f"{folder} was made from other weights than the weights of {run}; {how}")
    for name in (GRAPH, GRAPH_WEIGHTS):
        path = folder / name
        if not path.is_file() or file_hash(path) != about["files"].get(name):
            raise ModelError(f"{path} is missing or damaged; {how}")
    return folder / GRAPH


def parse_kind(text: str) -> EngineKind:
    """Return the kind of engine called `text`, "openvino" or "torch". Raises ModelError for another
    name."""
    if text not in get_args(EngineKind):
        raise ModelError(f"there is no engine {text!r}; choose openvino or torch")
    return cast(EngineKind, text)


def parse_precision(text: str | None) -> Precision | None:
    """Return the precision called `text`, "int8", "bf16" or "f32"; None, which stands for the
    default, is returned unchanged. Raises ModelError for another name."""
    if text not in (None, *get_args(Precision)):
        raise ModelError(f"there is no precision {text!r}; choose int8, bf16 or f32")
    return cast(Precision | None, text)


def has_openvino() -> bool:
    """Return whether OpenVINO is installed. Without it, models are trained and evaluated by torch
    alone."""
    return find_spec("openvino") is not None


def openvino_core() -> Any:
    """Return the only `openvino.Core` of this process; the first call makes it.

    OpenVINO's CPU plugin gives the thread that loads it an alternate signal stack (`sigaltstack`).
    It unmaps that stack when the last user of the plugin is dropped, in any thread; a later signal
    then ends the process with SIGSEGV. This core keeps the plugin loaded.
    """
    with _core_lock:
        return _make_core()


@cache
def _make_core() -> Any:
    # hwloc, which OpenVINO loads, writes to stderr where a container hides /sys.
    os.environ.setdefault("HWLOC_HIDE_ERRORS", "2")
    import openvino

    return openvino.Core()  # noqa: TID251


_core_lock = Lock()


def best_precision() -> Precision:
    """Return "bf16" if this CPU supports it natively (AVX512-BF16 or AMX), else "f32"."""
    capabilities = openvino_core().get_property("CPU", "OPTIMIZATION_CAPABILITIES")
    return "bf16" if "BF16" in capabilities else "f32"
