"""Actor and critic: two hidden layers and their gradients, in numpy on flat float32 vectors.

The gradients are written out because the networks are tiny: in torch's autograd nine tenths of the
time of an update are overhead. Tests compare the gradients with torch's.

A network is state -> hidden 1 (ReLU) -> hidden 2 (ReLU) -> one number. The critic's action joins
the output of hidden 1, so that it enters the last hidden layer, as in the paper's figure of the
networks. N networks of one shape are computed together from parameters (N, P). A row of the
parameters consists of W1 (state, h1), b1, W2 (h1 + actions, h2), b2, W3 (h2), b3.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float32]

SMALL_OUTPUT = 3e-3
"""Bound of the absolute values of the output layer's initial weights. With small weights the first
outputs are near 0 (Lillicrap et al. 2016, section 7)."""


class Shape(NamedTuple):
    """Sizes of a network's layers."""

    state: int
    h1: int
    h2: int
    actions: int = 0
    """Number of actions that join the output of hidden 1: 1 for a critic, 0 for an actor."""

    @property
    def parameters(self) -> int:
        """Number of parameters of one network, P."""
        return self.state * self.h1 + self.h1 + (self.h1 + self.actions + 2) * self.h2 + 1


class Layers(NamedTuple):
    """Views into the parameters of N networks, or into their gradients."""

    w1: Array  # (N, state, h1)
    b1: Array  # (N, 1, h1)
    w2: Array  # (N, h1 + actions, h2)
    b2: Array  # (N, 1, h2)
    w3: Array  # (N, h2, 1)
    b3: Array  # (N, 1, 1)


@dataclass(frozen=True)
class Activations:
    """The activations of N networks for B states: results of `forward`, inputs of `backward`."""

    x: Array  # (B, state)
    z: Array  # (N, B, h1 + actions)
    h2: Array  # (N, B, h2)
    out: Array  # (N, B)


def layers(theta: Array, shape: Shape) -> Layers:
    """Return views of the layers in the parameters `theta` (N, P); writing to a view changes
    `theta`."""
    state, h1, h2, actions = shape
    ends = np.cumsum([state * h1, h1, (h1 + actions) * h2, h2, h2]).tolist()
    w1, b1, w2, b2, w3, b3 = (
        theta[:, start:end] for start, end in zip([0, *ends], [*ends, None], strict=True)
    )
    count = len(theta)
    return Layers(
        w1.reshape(count, state, h1),
        b1[:, None],
        w2.reshape(count, h1 + actions, h2),
        b2[:, None],
        w3[:, :, None],
        b3[:, None],
    )


def initial(shape: Shape, count: int, rng: np.random.Generator) -> Array:
    """Return random initial parameters (count, P): uniform within +-1 / sqrt(inputs of the layer);
    in the output layer, weights within +-0.003 and bias 0."""
    theta = np.zeros((count, shape.parameters), np.float32)
    of = layers(theta, shape)
    for weights, bias in ((of.w1, of.b1), (of.w2, of.b2)):
        bound = 1.0 / np.sqrt(weights.shape[1])
        weights[:] = rng.uniform(-bound, bound, weights.shape)
        bias[:] = rng.uniform(-bound, bound, bias.shape)
    of.w3[:] = rng.uniform(-SMALL_OUTPUT, SMALL_OUTPUT, of.w3.shape)
    return theta


def forward(of: Layers, x: Array, actions: Array | None = None) -> Activations:
    """Return the activations of N networks for states `x` (B, state) and, for critics, `actions`
    (B,)."""
    z = np.matmul(x, of.w1)
    z += of.b1
    np.maximum(z, 0.0, out=z)
    if actions is not None:
        joined = np.empty((*z.shape[:2], z.shape[2] + 1), np.float32)
        joined[:, :, :-1], joined[:, :, -1] = z, actions
        z = joined
    h2 = np.matmul(z, of.w2)
    h2 += of.b2
    np.maximum(h2, 0.0, out=h2)
    out = np.matmul(h2, of.w3)
    out += of.b3
    return Activations(x, z, h2, out[:, :, 0])


def backward(of: Layers, seen: Activations, g_out: Array, gradient: Layers | None) -> Array:
    """Fill `gradient` with the gradient of sum(g_out * out) with respect to the parameters.

    `g_out` is (N, B). `seen` is the result of `forward`. Returns the gradient with respect to
    `seen.z` (N, B, h1 + actions), the input of hidden 2; its last column is a critic's gradient
    with respect to the action.
    """
    g2 = g_out[:, :, None] * of.w3.transpose(0, 2, 1)
    g2 *= seen.h2 > 0.0
    g_z: Array = np.matmul(g2, of.w2.transpose(0, 2, 1))
    if gradient is not None:
        width = of.w1.shape[2]
        g1 = g_z[:, :, :width] * (seen.z[:, :, :width] > 0.0)
        np.matmul(seen.x.T, g1, out=gradient.w1)
        np.sum(g1, axis=1, keepdims=True, out=gradient.b1)
        np.matmul(seen.z.transpose(0, 2, 1), g2, out=gradient.w2)
        np.sum(g2, axis=1, keepdims=True, out=gradient.b2)
        np.matmul(seen.h2.transpose(0, 2, 1), g_out[:, :, None], out=gradient.w3)
        np.sum(g_out[:, :, None], axis=1, keepdims=True, out=gradient.b3)
    return g_z
