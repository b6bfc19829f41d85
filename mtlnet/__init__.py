"""The multi-task perception network: training, evaluation, export and inference.

`from mtlnet import load` gives the Python interface (`mtlnet.api`).
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mtlnet.api import Features, Model, load

__all__ = ["Features", "Model", "load"]


def __getattr__(name: str) -> Any:
    """Import the interface when it is used: `import mtlnet` alone loads neither numpy nor torch."""
    if name not in __all__:
        raise AttributeError(f"module 'mtlnet' has no attribute {name!r}")
    from mtlnet import api

    return getattr(api, name)
