"""A trained actor: its network and its files. The module imports neither torch nor numba.

An actor's folder contains `actor.safetensors` (float32 arrays w1, b1, w2, b2, w3, b3) and the card
`actor.json`.
"""

import json
import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.numpy import load, save

import trackfeatures as tf
from controllers.laws.actor_state import StateDefinition, find_state
from runtime.files import atomic_write, write_json
from trackfeatures.errors import UserError

WEIGHTS, CARD = "actor.safetensors", "actor.json"
SHIPPED = Path(__file__).parent.parent / "weights"
"""Folder of the shipped actors, each in a folder of its name."""
FORMAT = 1
NAMES = ("w1", "b1", "w2", "b2", "w3", "b3")
Array = NDArray[np.float32]


class ActorError(UserError):
    """The files of an actor are missing or damaged, or its state vector or version differs from
    this program's."""


@dataclass(frozen=True)
class ActorCard:
    """The description of a trained actor and of its training."""

    state: str
    """Name of the definition of the state vector."""
    parts: tuple[str, ...]
    """Names of the numbers of the state vector, in their order."""
    half_width_m: float
    """Half the width of the track of the training; it divides the lateral offset."""
    divisor: tuple[float, ...]
    """Divisors of the numbers of the state vector; the network receives the quotients."""
    odd: bool
    """Whether the action is half the difference between the network's outputs for the state and for
    its mirror image."""
    hidden: tuple[int, int]
    algorithm: str
    track: str
    seed: int
    step: int
    """Step of the training after which this actor was saved."""
    score_per_step: float
    """Mean reward per step of the actor's evaluation drives (for one car: the drive on the training
    track). The actor with the largest mean is kept."""
    reward: str = "paper"
    """Name of the reward of the training."""
    format: int = FORMAT
    definitions_version: str = tf.VERSION


class Actor:
    """A trained network: state, two hidden layers with ReLU, one output with tanh.

    `weights` has w1 (size, h1), b1 (h1,), w2 (h1, h2), b2 (h2,), w3 (h2,) and b3 (1,), for states
    of `size` numbers and hidden layers of h1 and h2 units.
    """

    def __init__(self, card: ActorCard, weights: dict[str, Array]) -> None:
        self.card = card
        self.weights = weights
        self.definition = find_state(card.state)
        first = (weights["w1"] / np.array(card.divisor)[:, None]).astype(np.float32)
        if card.odd:  # one product computes the first layer for the state and its mirror image
            order, signs = mirror_of(self.definition)
            mirrored = np.empty_like(first)
            mirrored[order] = first * signs[:, None]
            first = np.hstack((first, mirrored))
        self._w1 = first
        self._rows = 2 if card.odd else 1

    def steer(self, state: Array) -> float:
        """Return the action in [-1, 1], left positive, for a state (size,)."""
        of = self.weights
        hidden = (state @ self._w1).reshape(self._rows, -1)
        hidden = np.maximum(hidden + of["b1"], 0.0)
        hidden = np.maximum(hidden @ of["w2"] + of["b2"], 0.0)
        actions = (hidden @ of["w3"] + of["b3"]).tolist()
        if self._rows == 1:
            return math.tanh(actions[0])
        return 0.5 * (math.tanh(actions[0]) - math.tanh(actions[1]))


def mirror_of(definition: StateDefinition) -> tuple[NDArray[np.intp], Array]:
    """Return the order and the signs, each (size,), that exchange left and right in a state: the
    mirrored state is state[order] * signs."""
    return np.array(definition.order, np.intp), np.array(definition.odd, np.float32)


def save_actor(folder: Path, actor: Actor) -> None:
    """Write the two files of `actor` to the existing `folder`."""
    atomic_write(folder / WEIGHTS, save(actor.weights), fsync=True)
    write_json(folder / CARD, asdict(actor.card))


def is_actor(folder: Path) -> bool:
    """Whether `folder` contains the card of an actor."""
    return (folder / CARD).is_file()


def load_actor(folder: Path) -> Actor:
    """Load the actor in `folder`.

    Raises ActorError for missing or damaged files, and for an actor whose state vector or version
    differs from this program's, because it would steer the car off the road.
    """
    card = _read_card(folder / CARD)
    path = folder / WEIGHTS
    try:
        weights = load(path.read_bytes())
    except (OSError, SafetensorError) as error:
        raise ActorError(f"the weights {path} cannot be read ({error}); train again") from error
    size, (h1, h2) = len(card.parts), card.hidden
    wanted = {"w1": (size, h1), "b1": (h1,), "w2": (h1, h2), "b2": (h2,), "w3": (h2,), "b3": (1,)}
    found = {name: array.shape for name, array in weights.items()}
    finite = all(np.isfinite(array).all() for array in weights.values())
    if found != wanted or not finite:
        what = f"of shapes {found}, the card's network has {wanted}" if finite else "not finite"
        raise ActorError(f"the weights {path} are {what}; train again")
    return Actor(card, weights)


def _read_card(path: Path) -> ActorCard:
    try:
        content: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        if content.get("format") != FORMAT:
            raise ActorError(
                f"the actor {path} is of format {content.get('format')}, this program reads "
                f"{FORMAT}; train again"
            )
        tf.require_version(str(content.get("definitions_version")), f"the actor {path}")
        content |= {name: tuple(content[name]) for name in ("parts", "hidden", "divisor")}
        content["divisor"] = tuple(map(float, content["divisor"]))
        card = ActorCard(**content)
    except (OSError, ValueError, TypeError, KeyError, AttributeError) as error:
        raise ActorError(f"the actor's card {path} cannot be read ({error!r})") from error
    definition = find_state(card.state)
    if card.parts != definition.parts:
        raise ActorError(
            f"the actor {path} was trained on the state {', '.join(card.parts)}; this program's "
            f"state {card.state!r} is {', '.join(definition.parts)}; train again"
        )
    scales = (card.half_width_m, *card.divisor)
    if len(scales) != 1 + definition.size or not min(scales) > 0.0:
        raise ActorError(
            f"the actor {path} divides by half_width_m {card.half_width_m} and {card.divisor}; it "
            f"needs a number above 0 for each of {definition.size}; train again"
        )
    return card
