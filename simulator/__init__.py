"""VTORCS: tracks, physics, traffic, sensors, camera and the Gymnasium environments.

The environments are registered with Gymnasium when this package is imported after `gymnasium`, or
by `import simulator.env`; Gymnasium 1.0 and later does not search packages for environments.
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
"""Classes that step many cars in one call, for `gymnasium.make_vec`."""
MAX_STEPS = 6500
"""The paper's longest episode, in control steps."""


def register_environments() -> None:
    """Register both environments; those already registered stay as they are."""
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
