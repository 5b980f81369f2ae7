"""Contact-GraspNet (Sundermeyer et al., ICRA 2021): grasps from a depth image by a neural network.

Written from a description of the network alone; its weights are not part of this package. torch is
needed, and is imported when a name of this package is first used.
"""

from importlib import import_module
from typing import Any

from tog_drake.errors import InputError

_MODULE_OF = {"ContactGraspNet": "network"}

__all__ = list(_MODULE_OF)


def __getattr__(name: str) -> Any:
    if name not in _MODULE_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    require_torch()
    return getattr(import_module(f"{__name__}.{_MODULE_OF[name]}"), name)


def __dir__() -> list[str]:
    return sorted(__all__)


def require_torch() -> None:
    """Loads torch.

    Raises:
        InputError: it is not installed; says how to install it.
    """
    try:
        import_module("torch")
    except ImportError as error:
        raise InputError(
            f"Contact-GraspNet needs torch, which cannot be imported ({error}); "
            "install it with: pip install 'tog_drake[cgn]'"
        ) from None
