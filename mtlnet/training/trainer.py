"""Trains a network: a `Trainer` holds the network and its optimizers, and takes training steps."""

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor, nn

from mtlnet.architecture import MTL, Architecture
from mtlnet.data.gpu_cache import DeviceBatch, on_device
from mtlnet.data.loader import Batch, Loader
from mtlnet.model.auxiliary import auxiliary_loss
from mtlnet.model.bins import Scores
from mtlnet.model.cpu_kernels.forward import FAST, forward_grid, forward_shared, training_outputs
from mtlnet.model.network import Network, initialise
from mtlnet.training.cuda_graph import CudaGraphStep, CudaRecorder
from mtlnet.training.distributed import SINGLE_PROCESS, Rank, average, dropout_seed
from mtlnet.training.losses.bins import bins_loss
from mtlnet.training.losses.multi_task import Losses, multi_task_loss
from mtlnet.training.losses.task_weighting import TaskWeighting
from mtlnet.training.losses.task_weights import Alpha
from mtlnet.training.optimizers import OptimizerSet
from mtlnet.training.recipes import Recipe, frozen_convolutions, learning_rate
from runtime.processor import has_bf16

MIN_TARGET_STD = (0.01,) * 6
"""Lower bounds (6,) of the standard deviations of the coded targets, the units of the heads."""
FINE_TUNE_MIN_STD = (0.15,) * 5 + (0.03,)
"""Lower bounds (6,) for fine-tuning: the standard deviations in varied driving. They are larger,
because the few images of a fine-tuning can be nearly identical."""
MIN_STEPS_BEFORE_BN_FREEZE = 100
"""Minimum number of steps before batch normalisation is frozen: earlier, its running statistics
still depend on the initial weights."""


class Trainer:
    """Trains a network; `step_number` counts the steps taken.

    `task_weighting`: None for the fixed weights `alpha`. `folded`: the network has no batch
    normalisation, because it starts from a finished model.
    """

    def __init__(
        self,
        recipe: Recipe,
        alpha: Alpha,
        seed: int,
        device: torch.device,
        architecture: Architecture = MTL,
        *,
        task_weighting: TaskWeighting | None = None,
        rank: Rank = SINGLE_PROCESS,
        folded: bool = False,
    ) -> None:
        self.recipe = recipe
        self.seed = seed
        self.device = device
        self.rank = rank
        self.task_weighting = task_weighting or TaskWeighting("fixed", alpha, device)
        self.step_number = 0
        network = Network(
            batch_norm=recipe.batch_norm or (bool(architecture.backbone) and not folded),
            dropout=recipe.dropout,
            architecture=architecture,
        )
        initialise(network, seed)
        self.network = network.to(device).to(memory_format=torch.channels_last)
        self.optimizers = OptimizerSet(
            self.network,
            recipe,
            self.task_weighting.parameters,
            capturable=device.type == "cuda",
        )
        self.cuda_graph = self._cuda_graph()
        self.seed_dropout()

    def _cuda_graph(self) -> CudaGraphStep | None:
        """The recorded step on a GPU; None on a CPU, and for several processes, which exchange
        gradients within a step."""
        if self.device.type != "cuda" or self.rank.world_size > 1:
            return None
        return CudaGraphStep(self.optimize, CudaRecorder(self.device))

    def seed_dropout(self) -> None:
        """Seed torch's global generators, because torch's dropout layers use them and do not accept
        a generator as an argument."""
        if self.recipe.dropout:
            torch.manual_seed(dropout_seed(self.seed, self.rank.index, self.step_number))

    def standardise(self, loader: Loader, *, fine_tune: bool = False) -> None:
        """Set `target_mean` and `target_std` of the network to the mean and standard deviation of
        the coded training targets. A head of coded values outputs a coded value minus this mean,
        divided by this standard deviation.

        `fine_tune`: the training starts from a finished model, perhaps with few images. The lower
        bounds of the standard deviations are then 0.15 for a distance and 0.03 for the angle, else
        0.01. Does nothing unless the recipe standardises.
        """
        if not self.recipe.standardise:
            return
        coded = torch.from_numpy(loader.coded).double()
        known = coded.isfinite()
        mean = torch.where(known.any(0), coded.nanmean(0), coded.new_tensor(0.5))
        std = (torch.where(known, coded - mean, 0.0) ** 2).sum(0) / known.sum(0).clamp_min(1)
        std = std.sqrt()
        least = FINE_TUNE_MIN_STD if fine_tune else MIN_TARGET_STD
        std = std.clamp_min(torch.tensor(least, dtype=std.dtype))
        self.network.target_mean.copy_(mean)
        self.network.target_std.copy_(std)

    @property
    def target_variance(self) -> Tensor | None:
        """The unit (6,) of the squared errors in the loss, the squared `target_std` of the network;
        None if the recipe does not standardise."""
        return self.network.target_std.square() if self.recipe.standardise else None

    def step(self, batch: Batch | DeviceBatch, progress: float) -> Losses:
        """Train on one batch; returns its losses before the weights changed.

        `progress`: fraction in [0, 1] of the run that is done.
        """
        self.network.train()
        settled = self.step_number >= MIN_STEPS_BEFORE_BN_FREEZE
        frozen_norm = settled and progress >= self.recipe.freeze_bn_at
        if frozen_norm:
            freeze_batch_norm(self.network)
        frozen = frozen_convolutions(self.recipe, progress)
        freeze_convolutions(self.network, frozen)
        rate = learning_rate(self.recipe, self.step_number, progress)
        self.optimizers.set_learning_rate(rate)
        moved = on_device(batch, self.device)
        graph = self.cuda_graph
        losses = self.optimize(moved) if graph is None else graph(moved, (frozen, frozen_norm))
        self.task_weighting.update(losses.terms)
        self.step_number += 1
        return losses

    def optimize(self, batch: DeviceBatch) -> Losses:
        """Update the weights with one batch, at the current learning rate; returns the losses
        before the update, averaged over all processes."""
        losses = self.losses(batch)
        self.optimizers.zero_grad()
        losses.total.backward()  # type: ignore[no-untyped-call]  # torch leaves it untyped
        reported = [losses.distance, losses.angle, losses.heading, losses.total.detach()]
        average([*reported, losses.terms, *self.optimizers.gradients()])
        self.optimizers.step()
        return losses

    def losses(self, batch: DeviceBatch) -> Losses:
        """Compute the losses of the current weights for a batch."""
        total = self.task_weighting.total
        if self.network.architecture.bins:
            scores, auxiliary = self.scores(batch.images, batch.ahead)
            return bins_loss(scores, batch.coded, batch.heading, total, auxiliary)
        return multi_task_loss(
            self.outputs(batch.images),
            batch.coded,
            batch.heading,
            total,
            self.target_variance,
            self.recipe.huber,
        )

    def outputs(self, images: Tensor) -> Tensor:
        """Compute the outputs (B, 9), with the network in training mode, for images uint8
        (B, 210, 280, 3)."""
        dtype = self._dtype()
        if self.device.type == "cpu" and self.network.architecture.features in FAST:
            return training_outputs(self.network, images, dtype, self._masks(len(images)))
        with torch.autocast(self.device.type, dtype, enabled=dtype != torch.float32):
            outputs: Tensor = self.network(images)
        return outputs

    def scores(self, images: Tensor, ahead: Tensor) -> tuple[Scores, Tensor | None]:
        """Compute the scores of the heads, with the network in training mode, for images uint8
        (B, 210, 280, 3), and the auxiliary loss, a scalar, for the labels `ahead` (B, 28) of the
        road ahead. The auxiliary loss is None if the network has no auxiliary heads or if there are
        no labels (B, 0)."""
        network, dtype = self.network, self._dtype()
        if self.device.type == "cpu" and network.architecture.features in FAST:
            grid = forward_grid(network, images, dtype)
            x = forward_shared(network, grid, dtype, self._masks(len(images)))
        else:
            with torch.autocast(self.device.type, dtype, enabled=dtype != torch.float32):
                grid = network.forward_grid(images)
                x = network.shared(grid.flatten(1))
        auxiliary = None
        if network.auxiliary is not None and ahead.shape[1]:
            auxiliary = auxiliary_loss(network.auxiliary(grid, x), ahead)
        return network.forward_scores(x), auxiliary

    def _dtype(self) -> torch.dtype:
        on_cpu = self.device.type == "cpu"
        return torch.bfloat16 if not on_cpu or has_bf16() else torch.float32

    def _masks(self, count: int) -> list[Tensor]:
        layers, seed = self.network.architecture.shared, [self.seed, 3, self.step_number]
        part = (self.rank.index, self.rank.world_size)
        return dropout_masks(self.recipe.dropout, layers, count, seed, part)


def freeze_batch_norm(network: Network) -> None:
    """Freeze the statistics of batch normalisation until the next `network.train()`."""
    for module in network.modules():
        if isinstance(module, nn.BatchNorm2d):
            module.eval()


def freeze_convolutions(network: Network, count: int) -> None:
    """Freeze the first `count` convolutions (no gradients) and unfreeze all other convolutions."""
    for number, name in enumerate(network.architecture.convolutions):
        for parameter in network.features.get_submodule(name).parameters():
            parameter.requires_grad_(number >= count)


def dropout_masks(
    probability: float,
    layers: Sequence[int],
    count: int,
    seed: list[int],
    part: tuple[int, int] = (0, 1),
) -> list[Tensor]:
    """Draw dropout masks (count, units), one for each number of units in `layers`, with the values
    0 and 1 / (1 - probability). `count`: images of this process. Without dropout the list is empty.

    The masks are a function of the seed, so that a run can be resumed without the state of a
    generator. `part`: index of this process and number of processes, which together use the masks
    that a single process would use.
    """
    if not probability:
        return []
    index, parts = part
    rng = np.random.default_rng(seed)
    rows = slice(index * count, (index + 1) * count)
    drawn = [rng.random((parts * count, units), np.float32)[rows] for units in layers]
    return [torch.from_numpy((d >= probability) / np.float32(1 - probability)) for d in drawn]
