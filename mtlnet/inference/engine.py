"""Running a trained model on images: OpenVINO by default, torch in float32 as the oracle.

Free of torch until the torch engine is asked for: the serving image has none. An engine takes one
image as it came from the camera, uint8 RGB; its normalisation is part of the exported graph.
"""

from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from mtlnet.inference.exported import int8_graph, passed_gate
from mtlnet.inference.model_card import (
    DOUBT,
    GRAPH,
    GRAPH_WEIGHTS,
    WEIGHTS,
    ModelCard,
    ModelError,
    check_files,
    read_card,
)
from mtlnet.inference.uncertainty import read_doubt, texture

if TYPE_CHECKING:
    from mtlnet.model.network import Network

Kind = Literal["openvino", "torch"]
Precision = Literal["bf16", "f32", "int8"]


class Engine(Protocol):
    """A model ready to run; not to be shared between threads."""

    @property
    def card(self) -> ModelCard:
        """What the model is."""

    @property
    def kind(self) -> str:
        """The program that runs it: "openvino" or "torch"."""

    @property
    def precision(self) -> str:
        """What it computes in: "f32", "bf16" or "int8"."""

    def __call__(self, image: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Image (H, W, 3) RGB of `card.camera`'s size -> outputs (9,) or (17,), see `answer`."""


def load_engine(
    run: Path,
    kind: Kind = "openvino",
    precision: Precision | None = None,
    threads: int = 1,
) -> Engine:
    """The model of folder `run` (see `mtlnet.inference.model_card.resolve_run`), ready to run.

    `precision` None: int8 where the model has a graph of it that passed its gate, else bf16 where
    the CPU computes in it, float32 elsewhere. The torch engine knows
    float32 only. Raises ModelError when the model is missing, unfinished or damaged.
    """
    card = read_card(run)
    if kind == "torch":
        if precision not in (None, "f32"):
            raise ModelError("the torch engine is the float32 oracle; ask for precision f32")
        return TorchEngine(run, card, threads)
    return OpenVinoEngine(run, card, precision, threads)


class OpenVinoEngine:
    """The exported graph, compiled for this CPU. `precision` is what it really computes in."""

    kind = "openvino"

    def __init__(
        self, run: Path, card: ModelCard, precision: Precision | None = None, threads: int = 1
    ) -> None:
        import openvino

        check_files(run, card, (GRAPH, GRAPH_WEIGHTS))
        core = openvino.Core()
        self.card = card
        best = best_precision(core)
        self.precision: Precision = precision or ("int8" if passed_gate(run, card) else best)
        eight = self.precision == "int8"
        graph = int8_graph(run, card) if eight else run / GRAPH
        options = {
            "INFERENCE_PRECISION_HINT": best if eight else self.precision,
            "INFERENCE_NUM_THREADS": threads,
            "NUM_STREAMS": 1,
            # Two workers told to pin would choose the same core.
            "ENABLE_CPU_PINNING": False,
        }
        try:
            model = core.read_model(str(graph))
            compiled = core.compile_model(model, "CPU", options)
        except RuntimeError as error:
            reason = str(error).strip().splitlines()[-1]
            raise ModelError(f"OpenVINO cannot load {graph}: {reason}") from error
        self._request = compiled.create_infer_request()
        self._shape = tuple(compiled.input(0).shape)
        self._input: NDArray[np.uint8] = np.empty(self._shape, np.uint8)
        self._request.set_input_tensor(0, openvino.Tensor(self._input, shared_memory=True))
        self._output: NDArray[np.float32] = self._request.get_output_tensor(0).data

    def __call__(self, image: NDArray[np.uint8]) -> NDArray[np.float32]:
        check_image(image, self._shape[1:])
        self._input[0] = image
        self._request.infer()
        outputs: NDArray[np.float32] = self._output[0].copy()
        return outputs


class TorchEngine:
    """The same network in torch, float32: the oracle the exported graph is held against."""

    kind = "torch"

    def __init__(self, run: Path, card: ModelCard, threads: int = 1) -> None:
        import torch

        from mtlnet.model.network import load_network

        names = (WEIGHTS,) if card.doubt is None else (WEIGHTS, DOUBT)
        check_files(run, card, names)
        torch.set_num_threads(threads)
        self.card = card
        self.precision: Precision = "f32"
        self._network: Network = load_network(run / WEIGHTS, card.network)
        self._doubt = None if card.doubt is None else read_doubt(run)
        self._shape = (card.camera.height, card.camera.width, 3)

    def __call__(self, image: NDArray[np.uint8]) -> NDArray[np.float32]:
        from mtlnet.model.network import describe_images

        check_image(image, self._shape)
        x, outputs = describe_images(self._network, image[None])
        if self._doubt is not None:
            outputs = np.concatenate([outputs, self._doubt.assess(x, texture(image)[None])], 1)
        answer: NDArray[np.float32] = outputs[0]
        return answer


def parse_kind(text: str) -> Kind:
    """The engine called `text`; ModelError when there is none."""
    kinds: dict[str, Kind] = {"openvino": "openvino", "torch": "torch"}
    if text in kinds:
        return kinds[text]
    raise ModelError(f"there is no engine {text!r}; choose openvino or torch")


def parse_precision(text: str | None) -> Precision | None:
    """The precision called `text`, None for the CPU's best; ModelError when there is none."""
    precisions: dict[str, Precision] = {"bf16": "bf16", "f32": "f32", "int8": "int8"}
    if text is None:
        return None
    if text in precisions:
        return precisions[text]
    raise ModelError(f"there is no precision {text!r}; choose int8, bf16 or f32")


def best_precision(core: Any) -> Precision:
    """bf16 where this CPU computes in it natively (AVX512-BF16 or AMX), float32 elsewhere."""
    return "bf16" if "BF16" in core.get_property("CPU", "OPTIMIZATION_CAPABILITIES") else "f32"


def check_image(image: NDArray[np.uint8], shape: tuple[int, ...]) -> None:
    """Raise ModelError unless `image` is uint8 of `shape` (height, width, 3)."""
    if image.shape != tuple(shape) or image.dtype != np.uint8:
        raise ModelError(
            f"the image is {image.dtype} of shape {image.shape}; this model takes uint8 RGB of "
            f"shape {tuple(shape)} (height, width, 3): scale it first"
        )
