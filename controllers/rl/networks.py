"""Actor and critic: two hidden layers, as compiled code on flat float32 vectors of parameters.

Written out because these networks are tiny: an update by torch's autograd takes 2 to 8 ms here, of
which the arithmetic is a tenth. The gradients are tested against torch's.

One network is state -> hidden 1 (ReLU) -> hidden 2 (ReLU) -> one number. The critic's action joins
the output of hidden 1, so that it enters the last hidden layer (the paper's figure of the networks).
Its parameters lie in one vector: W1 (state, h1), b1, W2 (h1 + actions, h2), b2, W3 (h2), b3.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from runtime.jit import compiled

Vector = NDArray[np.float32]
Matrix = NDArray[np.float32]
Shape = tuple[int, int, int, int]
"""Sizes of the state, hidden 1, hidden 2, and number of actions that enter hidden 2 (0 or 1)."""

SMALL_OUTPUT = 3e-3
"""Bound of the output layer's first weights, so that the first answers are near 0 (Lillicrap et al.
2016, section 7)."""


@dataclass(frozen=True)
class Layers:
    """Views into a vector of parameters."""

    w1: Matrix
    b1: Vector
    w2: Matrix
    b2: Vector
    w3: Vector
    b3: Vector


def parameter_count(shape: Shape) -> int:
    """Length of the vector of a network's parameters."""
    state, h1, h2, actions = shape
    return state * h1 + h1 + (h1 + actions) * h2 + h2 + h2 + 1


def layers(theta: Vector, shape: Shape) -> Layers:
    """The layers of a vector of parameters; writing to them writes to the vector."""
    state, h1, h2, actions = shape
    ends = np.cumsum([state * h1, h1, (h1 + actions) * h2, h2, h2])
    w1, b1, w2, b2, w3, b3 = np.split(theta, ends)
    return Layers(w1.reshape(state, h1), b1, w2.reshape(h1 + actions, h2), b2, w3, b3)


def initial(shape: Shape, rng: np.random.Generator) -> Vector:
    """First parameters: uniform within one over the root of each layer's inputs."""
    theta = np.empty(parameter_count(shape), np.float32)
    of = layers(theta, shape)
    for weights, bias in ((of.w1, of.b1), (of.w2, of.b2)):
        bound = 1.0 / np.sqrt(len(weights))
        weights[:] = rng.uniform(-bound, bound, weights.shape)
        bias[:] = rng.uniform(-bound, bound, bias.shape)
    of.w3[:] = rng.uniform(-SMALL_OUTPUT, SMALL_OUTPUT, of.w3.shape)
    of.b3[:] = 0.0
    return theta


@compiled
def _dense(x: Matrix, w: Matrix, b: Vector, out: Matrix) -> None:
    """out[:, :len(b)] = relu(x w + b). Rows of w are added, so that the inner loop is a vector
    operation without reordering a sum, and inputs of 0 (half of a ReLU's) cost nothing."""
    columns = w.shape[1]
    for row in range(x.shape[0]):
        for j in range(columns):
            out[row, j] = b[j]
        for i in range(w.shape[0]):
            value = x[row, i]
            if value != 0.0:
                for j in range(columns):
                    out[row, j] += value * w[i, j]
        for j in range(columns):
            out[row, j] = max(out[row, j], np.float32(0.0))


@compiled
def forward(
    theta: Vector, shape: Shape, x: Matrix, action: Vector, z: Matrix, h2: Matrix, out: Vector
) -> None:
    """Fill z (B, h1 + actions), h2 (B, h2) and the answers out (B,) for the states x (B, state)."""
    state, n1, n2, actions = shape
    a = state * n1
    c = a + n1 + (n1 + actions) * n2
    _dense(x, theta[:a].reshape((state, n1)), theta[a : a + n1], z)
    if actions:
        z[:, n1] = action
    _dense(z, theta[a + n1 : c].reshape((n1 + actions, n2)), theta[c : c + n2], h2)
    w3, b3 = theta[c + n2 : c + 2 * n2], theta[c + 2 * n2]
    for row in range(x.shape[0]):
        total = b3
        for j in range(n2):
            total += h2[row, j] * w3[j]
        out[row] = total


@compiled
def backward(
    theta: Vector,
    shape: Shape,
    x: Matrix,
    z: Matrix,
    h2: Matrix,
    g_out: Vector,
    gradient: Vector,
    g_action: Vector,
) -> None:
    """Fill the gradient of sum(g_out * out) by the parameters, and by the actions g_action (B,).

    z and h2 are those of `forward`.
    """
    state, n1, n2, actions = shape
    a = state * n1
    c = a + n1 + (n1 + actions) * n2
    gradient[:] = np.float32(0.0)
    g_w1, g_b1 = gradient[:a].reshape((state, n1)), gradient[a : a + n1]
    g_w2, g_b2 = gradient[a + n1 : c].reshape((n1 + actions, n2)), gradient[c : c + n2]
    g_w3 = gradient[c + n2 : c + 2 * n2]
    w2_columns = theta[a + n1 : c].reshape((n1 + actions, n2)).T.copy()
    w3 = theta[c + n2 : c + 2 * n2]
    g2 = np.empty(n2, np.float32)
    g1 = np.empty(n1 + actions, np.float32)
    for row in range(x.shape[0]):
        g = g_out[row]
        gradient[c + 2 * n2] += g
        g1[:] = np.float32(0.0)
        for j in range(n2):
            g_w3[j] += g * h2[row, j]
            g2[j] = g * w3[j] if h2[row, j] > 0.0 else np.float32(0.0)
            g_b2[j] += g2[j]
            if g2[j] != 0.0:
                for i in range(n1 + actions):
                    g1[i] += g2[j] * w2_columns[j, i]
        if actions:
            g_action[row] = g1[n1]
        for i in range(n1 + actions):
            value = z[row, i]
            if value != 0.0:
                for j in range(n2):
                    g_w2[i, j] += value * g2[j]
        for i in range(n1):
            if z[row, i] <= 0.0:
                g1[i] = np.float32(0.0)
            g_b1[i] += g1[i]
        for k in range(state):
            value = x[row, k]
            for i in range(n1):
                g_w1[k, i] += value * g1[i]
