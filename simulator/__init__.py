"""VTORCS, the driving simulator: tracks, physics, traffic, sensors, camera, Gymnasium environments.

The environments are registered with Gymnasium when this package is imported after `gymnasium`, or
when `simulator.env` is imported. Gymnasium 1.0 and later does not search packages for environments.
"""

import sys

ENVIRONMENTS = {
    "driverview/LateralControl-v0": "simulator.env:LateralControl",
    "driverview/DriverView-v0": "simulator.env:DriverView",
}
VECTORS = {
    "driverview/LateralControl-v0": "simulator.env.vector:LateralControlVector",
    "driverview/DriverView-v0": "simulator.env.vector:DriverViewVector",
}
"""Classes for `gymnasium.make_vec`, which step many cars in one call."""
MAX_STEPS = 6500
"""Number of control steps of the paper's longest episode (on the track forza). Longer episodes are
truncated."""


def register_environments() -> None:
    """Register `driverview/LateralControl-v0` and `driverview/DriverView-v0` with Gymnasium, unless
    they are registered already."""
    import gymnasium

    for name, entry_point in ENVIRONMENTS.items():
        if name not in gymnasium.registry:
            gymnasium.register(
                id=name,
                entry_point=entry_point,
                vector_entry_point=VECTORS[name],
                max_episode_steps=MAX_STEPS,
            )


if "gymnasium" in sys.modules:  # commands without environments do not import gymnasium
    register_environments()
