"""How the three tasks are weighed against each other: `--balance fixed|uncertainty|dwa`.

`fixed`: the weights of `--alpha`, as in the paper. The others find weights themselves; alpha then
only says which tasks are learned (0: not).

`uncertainty` (Kendall, Gal and Cipolla 2018, equation 7): a task's variance exp(s) is learned with
the network; its term L counts exp(-s) L / 2 + s / 2, or exp(-s) L + s / 2 for classes.
`dwa` (Liu, Johns and Davison 2019, equation 7): tasks that fell less count more. A task's weight is
K exp(r / T) / sum(exp(r / T)), r its mean term over the last stretch of steps by that of the one
before; K the number of tasks, T = 2. A stretch is an epoch, or 500 steps where that is shorter.
"""

import torch
from torch import Tensor, nn

from mtlnet.training.loss import TASKS, Alpha
from trackfeatures.errors import UserError

BALANCES = ("fixed", "uncertainty", "dwa")
HALF = (0.5, 0.5, 1.0)  # of an error's term: a normal's exponent is halved, a softmax's is not
TEMPERATURE = 2.0
STRETCH = 500


def find_balance(name: str) -> str:
    """`name`; UserError when there is no such balance."""
    if name not in BALANCES:
        raise UserError(f"there is no balance {name!r}; choose one of {', '.join(BALANCES)}")
    return name


class Balance:
    """The weights of the tasks at this step, and what they depend on."""

    def __init__(self, kind: str, alpha: Alpha, device: torch.device, epoch: int = STRETCH) -> None:
        self.kind = find_balance(kind)
        self.used = torch.tensor([weight > 0 for weight in alpha], device=device)
        self.stretch = max(min(epoch, STRETCH), 1)
        self.log_variance = nn.Parameter(torch.zeros(len(TASKS), device=device))
        fixed = torch.tensor(alpha, device=device)
        self.current = fixed if kind == "fixed" else self.used.float()
        self.sums = torch.zeros(len(TASKS), dtype=torch.float64, device=device)
        self.before = torch.zeros_like(self.sums)
        self.counts = torch.zeros(2, dtype=torch.int64)  # steps in this stretch, stretches done

    @property
    def parameters(self) -> list[nn.Parameter]:
        """What is learned beside the network."""
        return [self.log_variance] if self.kind == "uncertainty" else []

    def total(self, terms: Tensor) -> Tensor:
        """The sum to minimise of the tasks' terms (3,)."""
        if self.kind != "uncertainty":
            # A weight of 0 takes the task out of the graph: a true single-task network.
            return (terms[self.used] * self.current[self.used]).sum()
        s, half = self.log_variance[self.used], torch.tensor(HALF, device=terms.device)
        return (half[self.used] * torch.exp(-s) * terms[self.used] + 0.5 * s).sum()

    @torch.no_grad()
    def weights(self) -> list[float]:
        """What each task's term is multiplied by now, for the curves."""
        if self.kind != "uncertainty":
            return [float(weight) for weight in self.current]
        learned = torch.tensor(HALF) * torch.exp(-self.log_variance.cpu()) * self.used.cpu()
        return [float(weight) for weight in learned]

    @torch.no_grad()
    def note(self, terms: Tensor) -> None:
        """Take in the terms (3,) of a step, of the whole batch: `dwa` weighs by them."""
        if self.kind != "dwa":
            return
        self.sums += terms
        self.counts[0] += 1
        if int(self.counts[0]) < self.stretch:
            return
        means = self.sums / self.stretch
        if int(self.counts[1]) > 0:
            pace = means[self.used] / self.before[self.used].clamp_min(1e-12) / TEMPERATURE
            share = torch.softmax(pace, 0) * int(self.used.sum())
            self.current[self.used] = share.float()
        self.before = means
        self.sums.zero_()
        self.counts = torch.tensor([0, int(self.counts[1]) + 1])

    def state(self) -> dict[str, Tensor]:
        """What a checkpoint keeps."""
        return {name: getattr(self, name).detach() for name in _KEPT}

    @torch.no_grad()
    def restore(self, state: dict[str, Tensor]) -> None:
        """Go on from a `state`. Raises KeyError when something is missing from it."""
        for name in _KEPT:
            getattr(self, name).copy_(state[name])


_KEPT = ("log_variance", "current", "sums", "before", "counts")
