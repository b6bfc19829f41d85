"""A trained actor as a controller. One `update` is three small matrix products in numpy."""

from pathlib import Path

from controllers.interface import Observation
from controllers.rl.actor import Actor, load_actor
from controllers.rl.state import StateBuilder, paper_state

SHIPPED = Path(__file__).parent.parent / "weights"


class RlController:
    """Steers as `actor` answers, without noise."""

    def __init__(self, actor: Actor) -> None:
        self._actor = actor
        self._states = StateBuilder(actor.definition)

    def update(self, observation: Observation) -> float:
        paper = paper_state(observation, self._actor.card.half_width_m)
        steer = self._actor.steer(self._states.build(paper, observation.yaw_rate))
        self._states.steered(steer)
        return steer


def load_controller(folder: Path) -> RlController:
    """The controller of an actor's folder. Raises ActorError for unusable files."""
    return RlController(load_actor(folder))


def shipped_controller(name: str) -> RlController:
    """An actor that ships with the project: `rl`."""
    return load_controller(SHIPPED / name)
