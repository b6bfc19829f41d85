"""The multi-task perception network: training, evaluation, export and inference.

`from mtlnet import load` gives the Python interface (`mtlnet.api`).
"""

import sys
from typing import TYPE_CHECKING, Any, cast

if TYPE_CHECKING:
    from mtlnet.api import Features, Model, load

# OpenVINO and NNCF use the package openvino_telemetry to send usage statistics to their makers,
# from a fork of the process that converts a model. Both also work without this package, and then
# send nothing.
sys.modules.setdefault("openvino_telemetry", cast(Any, None))

__all__ = ["Features", "Model", "load"]


def __getattr__(name: str) -> Any:
    """Import the object called `name` (`Features`, `Model` or `load`) from `mtlnet.api` and return
    it. Python calls this function when the object is used.

    So `import mtlnet` alone loads neither numpy nor torch. Raises AttributeError for any other
    name.
    """
    if name not in __all__:
        raise AttributeError(f"module 'mtlnet' has no attribute {name!r}")
    from mtlnet import api

    return getattr(api, name)
