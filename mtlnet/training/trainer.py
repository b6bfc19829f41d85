"""One network in training: its optimiser, its step, its state."""

import ctypes
import re
import sys
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from mtlnet.data.gpu_cache import DeviceBatch, on_device
from mtlnet.data.loader import Batch, Loader
from mtlnet.model.architecture import MTL, Architecture
from mtlnet.model.cpu_kernels.forward import training_outputs
from mtlnet.model.network import Network, initialise
from mtlnet.training.cuda_graph import CudaGraphStep, CudaRecorder
from mtlnet.training.distributed import ALONE, Part, average
from mtlnet.training.loss import Alpha, Losses, multi_task_loss
from mtlnet.training.optimizers import Optimisers
from mtlnet.training.recipes import Recipe, learning_rate, resting
from mtlnet.training.task_weighting import STRETCH, Balance
from trackfeatures.errors import UserError

MIN_TARGET_STD = 0.01
SETTLING_STEPS = 100
"""After so many the running statistics of batch normalisation know nothing of the first weights."""


class Trainer:
    """Trains a network; `step_number` counts the steps taken."""

    def __init__(
        self,
        recipe: Recipe,
        alpha: Alpha,
        seed: int,
        device: torch.device,
        plan: Architecture = MTL,
        *,
        balance: str = "fixed",
        epoch: int = STRETCH,
        part: tuple[int, int] = (0, 1),
        folded: bool = False,
    ) -> None:
        self.recipe = recipe
        self.alpha = alpha
        self.seed = seed
        self.device = device
        self.part = part
        self.balance = Balance(balance, alpha, device, epoch)
        self.step_number = 0
        network = Network(
            # A backbone has its own, unless it goes on from a finished model.
            batch_norm=recipe.batch_norm or (plan.backbone and not folded),
            dropout=recipe.dropout,
            architecture=plan,
        )
        initialise(network, seed)
        self.network = network.to(device).to(memory_format=torch.channels_last)
        self.optimisers = Optimisers(self.network, recipe, self.balance.parameters)
        self.scale: Tensor | None = None
        # Of the others, the rate changes at every step, or the weights of the tasks.
        lasting = recipe.optimiser == "sgd" and balance == "fixed" and part[1] == 1
        on_gpu = device.type == "cuda"
        self.captured = (
            CudaGraphStep(self.learn, CudaRecorder(device)) if lasting and on_gpu else None
        )
        if recipe.dropout:
            # Dropout takes no generator of its own: this is torch's only place for a seed.
            torch.manual_seed(seed)

    def standardise(self, loader: Loader, least: Sequence[float] = (MIN_TARGET_STD,) * 6) -> None:
        """Set the heads' units to the mean and standard deviation of the training targets.

        `least` (6,): no unit is smaller.
        """
        if not self.recipe.standardise:
            return
        coded = torch.from_numpy(loader.coded).double()
        mean, std = coded.mean(0), coded.std(0, correction=0)
        std = std.clamp_min(torch.tensor(least, dtype=std.dtype))
        self.network.target_mean.copy_(mean)
        self.network.target_std.copy_(std)
        self.scale = (std**2).float().to(self.device)

    def step(self, batch: Batch | DeviceBatch, progress: float) -> Losses:
        """Learn from one batch; its losses, before the step."""
        self.network.train()
        if progress >= self.recipe.settled and self.step_number >= SETTLING_STEPS:
            settle_norms(self.network)
        rest(self.network, resting(self.recipe, progress))
        rate = learning_rate(self.recipe, self.step_number, progress)
        self.optimisers.set_rate(rate)
        given = on_device(batch, self.device)
        losses = self.learn(given) if self.captured is None else self.captured(given, rate)
        self.balance.note(losses.terms)
        self.step_number += 1
        return losses

    def learn(self, batch: DeviceBatch) -> Losses:
        """Change the weights by one batch, at the rate that is set."""
        outputs = self.outputs(batch.images)
        combine, bend = self._combine(), self.recipe.bend
        losses = multi_task_loss(outputs, batch.coded, batch.heading, combine, self.scale, bend)
        self.optimisers.zero_grad()
        losses.total.backward()  # type: ignore[no-untyped-call]  # torch leaves it untyped
        seen = [losses.distance, losses.angle, losses.type, losses.total.detach(), losses.terms]
        average([*seen, *self.optimisers.gradients()])
        self.optimisers.step()
        return losses

    def _combine(self) -> Alpha | Callable[[Tensor], Tensor]:
        return self.alpha if self.balance.kind == "fixed" else self.balance.total

    def outputs(self, images: Tensor) -> Tensor:
        """What the network in training answers, (B, 9), to images (B, 210, 280, 3) uint8."""
        on_cpu = self.device.type == "cpu"
        dtype = torch.bfloat16 if not on_cpu or cpu_has_bf16() else torch.float32
        if on_cpu and self.network.architecture is MTL:
            seed = [self.seed, 3, self.step_number]
            masks = dropout_masks(self.recipe.dropout, MTL.shared, len(images), seed, self.part)
            return training_outputs(self.network, images, dtype, masks)
        with torch.autocast(self.device.type, dtype, enabled=dtype != torch.float32):
            answers: Tensor = self.network(images)
        return answers


def settle_norms(network: Network) -> None:
    """Let batch normalisation keep its statistics, until the next `network.train()`."""
    for module in network.modules():
        if isinstance(module, nn.BatchNorm2d):
            module.eval()


def rest(network: Network, count: int) -> None:
    """Let the first `count` convolutions keep their weights; no work goes into their gradients."""
    for number, name in enumerate(network.architecture.convolutions):
        for parameter in network.features.get_submodule(name).parameters():
            parameter.requires_grad_(number >= count)


def dropout_masks(
    share: float,
    layers: Sequence[int],
    count: int,
    seed: list[int],
    part: tuple[int, int] = (0, 1),
) -> list[Tensor]:
    """What is left of `layers` of so many units, scaled up; the same for one process or many.

    A mask is a function of the seed, so that a run can be resumed from its weights alone.
    """
    if not share:
        return []
    which, parts = part
    rng = np.random.default_rng(seed)
    rows = slice(which * count, (which + 1) * count)
    drawn = [rng.random((parts * count, units), np.float32)[rows] for units in layers]
    return [torch.from_numpy((d >= share) / np.float32(1 - share)) for d in drawn]


def keep_freed_memory() -> None:
    """Tell glibc to keep the memory of freed tensors: a step is then a sixth faster.

    By default it returns them to the kernel and page-faults them in again, 30,000 pages a step.
    """
    if not sys.platform.startswith("linux"):
        return
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is None:  # musl
        return
    trim_threshold, mmap_threshold = -1, -3
    mallopt(trim_threshold, 2**31 - 1)
    mallopt(mmap_threshold, 32 << 20)


# Where a run computes.


def choose_device(name: str, part: Part = ALONE) -> torch.device:
    """The device called `name`; "auto": a GPU where there is one."""
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    if name == "cuda" and part.local > 1:
        name = f"cuda:{part.local_rank}"
    if not re.fullmatch(r"cpu|cuda(:\d{1,3})?", name):
        raise UserError(f"--device {name!r} is not known; use auto, cpu, cuda or cuda:NUMBER")
    device = torch.device(name)
    if device.type == "cuda" and not torch.cuda.is_available():
        raise UserError(f"--device {name}: torch finds no GPU here; use --device cpu")
    if device.type == "cuda" and (device.index or 0) >= torch.cuda.device_count():
        raise UserError(f"--device {name}: torch finds {torch.cuda.device_count()} GPU(s) here")
    return device


@cache
def cpu_has_bf16() -> bool:
    """Whether the CPU multiplies bf16 natively (AVX512-BF16 or AMX); elsewhere it is slower."""
    info = Path("/proc/cpuinfo")
    if not info.is_file():
        return False
    text = info.read_text()
    return "avx512_bf16" in text or "amx_bf16" in text
