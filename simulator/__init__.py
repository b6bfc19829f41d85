"""VTORCS: tracks, physics, traffic, sensors, camera and the Gymnasium environments.

The environments are registered with Gymnasium when this package is imported after `gymnasium`, or
by `import simulator.env`; Gymnasium 1.0 and later does not search packages for environments.
"""

import sys

if "gymnasium" in sys.modules:  # commands without environments do not import gymnasium
    from simulator.registration import register_environments

    register_environments()
