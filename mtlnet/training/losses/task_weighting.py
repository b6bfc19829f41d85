"""Weights of the three tasks in the loss: `--balance fixed|uncertainty|dwa`.

`fixed` uses the weights of `--alpha`, as in the paper. The methods `uncertainty` and `dwa` set the
weights themselves; alpha then only selects the tasks (0: the task is not learned).

`uncertainty` (Kendall, Gal and Cipolla 2018, equation 7): the log variance s of each task is
learned with the network; a squared error L contributes exp(-s) L / 2 + s / 2, a cross-entropy
exp(-s) L + s / 2.

`dwa`, dynamic weight average (Liu, Johns and Davison 2019, equation 7): a task whose loss falls
more slowly gets more weight, K exp(r / T) / sum(exp(r / T)). Here r is the mean loss term over the
last window of steps divided by the mean over the window before it, K is the number of tasks, and
T = 2. A window has the steps of one epoch, but at most `WINDOW_STEPS`.
"""

import torch
from torch import Tensor, nn

from mtlnet.training.losses.multi_task import Terms
from mtlnet.training.losses.task_weights import TASKS, Alpha, require_method

LIKELIHOOD_FACTORS = (0.5, 0.5, 1.0)
"""Factors of exp(-s) L for distance, angle and class. A normal distribution has half the squared
error in its exponent; a cross-entropy is a log likelihood without a factor."""
TEMPERATURE = 2.0
WINDOW_STEPS = 500


class TaskWeighting:
    """The task weights at the current step, and the state on which the weights depend."""

    def __init__(
        self, method: str, alpha: Alpha, device: torch.device, steps_per_epoch: int = WINDOW_STEPS
    ) -> None:
        self.method = require_method(method)
        self.learned = torch.tensor([weight > 0 for weight in alpha], device=device)
        self._tasks = [number for number, weight in enumerate(alpha) if weight > 0]
        # Indices, because a CUDA graph cannot record a selection by a mask: its size is unknown.
        self._chosen = torch.tensor(self._tasks, device=device)
        self._factors = torch.tensor(LIKELIHOOD_FACTORS, device=device)[self._chosen]
        self.window = max(min(steps_per_epoch, WINDOW_STEPS), 1)
        self.log_variance = nn.Parameter(torch.zeros(len(TASKS), device=device))
        fixed = torch.tensor(alpha, device=device)
        self.weights = fixed if method == "fixed" else self.learned.float()
        self.sums = torch.zeros(len(TASKS), dtype=torch.float64, device=device)
        self.previous_means = torch.zeros_like(self.sums)
        self.counts = torch.zeros(2, dtype=torch.int64)
        """(2,): number of steps in the current window, number of completed windows."""

    @property
    def parameters(self) -> list[nn.Parameter]:
        """Parameters that are trained together with the network: the log variances (3,) for the
        method `uncertainty`, else none."""
        return [self.log_variance] if self.method == "uncertainty" else []

    def total(self, terms: Terms) -> Tensor:
        """Compute the weighted sum, a scalar, of the tasks' loss `terms`, which training minimises.
        For the method `uncertainty` half the log variance of each task is added.

        A task with weight 0 has no part in the sum's autograd graph, so a network trained on one
        task is not influenced by other tasks.
        """
        chosen = torch.stack([terms[number] for number in self._tasks])
        if self.method != "uncertainty":
            return (self.weights.index_select(0, self._chosen) * chosen).sum()
        s = self.log_variance.index_select(0, self._chosen)
        return (self._factors * torch.exp(-s) * chosen + 0.5 * s).sum()

    @torch.no_grad()
    def current_weights(self) -> list[float]:
        """Return the factor of each task's loss term at this step; 0 for a task that is not
        learned."""
        if self.method != "uncertainty":
            weights: list[float] = self.weights.tolist()  # one copy from a GPU, not three
            return weights
        factors = torch.tensor(LIKELIHOOD_FACTORS)
        learned = factors * torch.exp(-self.log_variance.cpu()) * self.learned.cpu()
        return [float(weight) for weight in learned]

    @torch.no_grad()
    def update(self, terms: Tensor) -> None:
        """For the method `dwa`, add the loss `terms` (3,) of a step, averaged over the whole batch,
        to the sums of the current window; for all other methods do nothing.

        When the window has at least `window` steps, a new window begins. New weights are computed
        at the end of each window except the first.
        """
        if self.method != "dwa":
            return
        self.sums += terms
        self.counts[0] += 1
        if int(self.counts[0]) < self.window:
            return
        means = self.sums / int(self.counts[0])  # a resumed run can have counted more than `window`
        if int(self.counts[1]) > 0:
            previous = self.previous_means[self.learned].clamp_min(1e-12)
            ratios = means[self.learned] / previous / TEMPERATURE
            weights = torch.softmax(ratios, 0) * int(self.learned.sum())
            self.weights[self.learned] = weights.float()
        self.previous_means = means
        self.sums.zero_()
        self.counts = torch.tensor([0, int(self.counts[1]) + 1])

    def state(self) -> dict[str, Tensor]:
        """Return the tensors to store in a checkpoint, by the names under which `restore` reads
        them."""
        return {
            "log_variance": self.log_variance.detach(),
            "current": self.weights,
            "sums": self.sums,
            "before": self.previous_means,
            "counts": self.counts,
        }

    @torch.no_grad()
    def restore(self, state: dict[str, Tensor]) -> None:
        """Restore the tensors that `state()` returned. Raises KeyError when one is missing."""
        for name, tensor in self.state().items():
            tensor.copy_(state[name])
