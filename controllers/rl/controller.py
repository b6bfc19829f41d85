"""A trained actor as a controller. One `update` is three small matrix products in numpy."""

from pathlib import Path

from controllers.interface import LoopConfig, Observation
from controllers.rl.actor import Actor, load_actor
from controllers.rl.state import STEP_S, StateBuilder, paper_state
from trackfeatures.errors import UserError

SHIPPED = Path(__file__).parent.parent / "weights"


class RlController:
    """Steers as `actor` answers, without noise."""

    def __init__(self, actor: Actor) -> None:
        self._actor = actor
        self._states = StateBuilder(actor.definition)

    def update(self, observation: Observation) -> float:
        paper = paper_state(observation, self._actor.card.half_width_m)
        return self._states.steer(self._actor.steer(self._states.build(paper, observation)))


def load_controller(folder: Path) -> RlController:
    """The controller of an actor's folder. Raises ActorError for unusable files."""
    return RlController(load_actor(folder))


def make_rl(loop: LoopConfig) -> RlController:
    """The actor of the paper's state that ships with the project; UserError for another rate."""
    return _shipped("rl", loop)


def make_rl_residual(loop: LoopConfig) -> RlController:
    """The actor that ships with the project and adds to LQR; UserError for another rate."""
    return _shipped("rl-residual", loop)


def _shipped(name: str, loop: LoopConfig) -> RlController:
    if loop.dt != STEP_S:
        raise UserError(f"{name} was trained for steps of {STEP_S:g} s, not {loop.dt:g}")
    return load_controller(SHIPPED / name)
