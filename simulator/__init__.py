"""VTORCS: tracks, physics, traffic, sensors, camera and the Gymnasium environments.

Gymnasium learns the environments' names when this package is imported after it, or from
`import simulator.env`; Gymnasium itself looks for no packages since its version 1.0.
"""

import sys

if "gymnasium" in sys.modules:  # a command that needs no environment does not pay for importing it
    from simulator.registration import register_environments

    register_environments()
