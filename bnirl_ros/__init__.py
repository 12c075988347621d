"""Bayesian nonparametric inverse reinforcement learning for ROS 2 (Michini & How 2012).

The names in `__all__` are the way in from Python. Each is imported when it is first asked for, so
that `import bnirl_ros` itself takes no time.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from bnirl_ros.bags.demonstration import read_demonstration
    from bnirl_ros.demonstrations.csv_file import read_csv
    from bnirl_ros.demonstrations.demonstration import Demonstration
    from bnirl_ros.demonstrations.placement import place
    from bnirl_ros.errors import InputError
    from bnirl_ros.inference.filtering import SubgoalFilter
    from bnirl_ros.inference.posterior import infer
    from bnirl_ros.inference.prediction import predict, predict_at, predict_from_mode
    from bnirl_ros.inference.settings import Settings
    from bnirl_ros.inference.summary import summarise
    from bnirl_ros.maps import FeatureMap, GridMap, load_features, load_map, with_features

__version__ = "0.1.0"

# Before anything imports a kernel.
import_module(f"{__name__}.kernel_cache").ensure_kernel_cache()

__all__ = [
    "Demonstration",
    "FeatureMap",
    "GridMap",
    "InputError",
    "Settings",
    "SubgoalFilter",
    "infer",
    "load_features",
    "load_map",
    "place",
    "predict",
    "predict_at",
    "predict_from_mode",
    "read_csv",
    "read_demonstration",
    "summarise",
    "with_features",
]

_MODULE_OF = {
    "Demonstration": "demonstrations.demonstration",
    "FeatureMap": "maps",
    "GridMap": "maps",
    "InputError": "errors",
    "Settings": "inference.settings",
    "SubgoalFilter": "inference.filtering",
    "infer": "inference.posterior",
    "load_features": "maps",
    "load_map": "maps",
    "place": "demonstrations.placement",
    "predict": "inference.prediction",
    "predict_at": "inference.prediction",
    "predict_from_mode": "inference.prediction",
    "read_csv": "demonstrations.csv_file",
    "read_demonstration": "bags.demonstration",
    "summarise": "inference.summary",
    "with_features": "maps",
}


def __getattr__(name: str) -> Any:
    if name not in _MODULE_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f"{__name__}.{_MODULE_OF[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
