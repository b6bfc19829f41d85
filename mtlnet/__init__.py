"""The multi-task perception network: training, evaluation, export and inference.

`from mtlnet import load` gives the Python interface (`mtlnet.api`).
"""

import sys
from typing import TYPE_CHECKING, Any, cast

if TYPE_CHECKING:
    from mtlnet.api import Features, Model, load

# OpenVINO and NNCF send usage statistics to their makers with this package, from a fork of the
# process that converts a model. Without it, which both allow, they send nothing.
sys.modules.setdefault("openvino_telemetry", cast(Any, None))

__all__ = ["Features", "Model", "load"]


def __getattr__(name: str) -> Any:
    """Import `Features`, `Model` or `load` from `mtlnet.api` at its first use and return it.

    So `import mtlnet` alone loads neither numpy nor torch. Raises AttributeError for another name.
    """
    if name not in __all__:
        raise AttributeError(f"module 'mtlnet' has no attribute {name!r}")
    from mtlnet import api

    return getattr(api, name)
