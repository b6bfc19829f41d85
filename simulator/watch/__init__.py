"""A live drive in the browser: pictures, plan of the track, sensors. No display is needed.

    simulator watch --track coast --lanes 2 --traffic 6

To watch a drive of your own program, for example in training:

    from simulator.watch import Watcher

    watcher = Watcher(port=8765)
    watcher.update(env)  # after every env.reset() and env.step()
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from simulator.watch.watcher import Watcher

__all__ = ["Watcher"]


def __getattr__(name: str) -> Any:
    # Imported at first use, so that the command reports bad options before it loads the simulator.
    if name == "Watcher":
        from simulator.watch.watcher import Watcher

        return Watcher
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
