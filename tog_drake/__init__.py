"""Training-free task-oriented grasping for the Franka Panda, built as Drake systems.

The public names, in the order of the data. Each is imported when it is first used, so that
``import tog_drake`` costs nothing.
"""

from importlib import import_module
from typing import Any

_MODULE_OF = {
    # values on ports
    "View": "values",
    "Grasps": "values",
    "FeasibleGrasps": "values",
    "Candidates": "values",
    "Choice": "values",
    "GraspMotion": "values",
    # stages
    "Camera": "camera",
    "SceneCloud": "cloud",
    "GraspProposer": "proposer",
    "Proposer": "proposer",
    "FeasibilityFilter": "feasibility",
    "CandidatePicker": "candidates",
    "GraspSelector": "selector",
    "Selector": "selector",
    "TrajectoryOptimizer": "trajectory",
    "GraspExecutor": "executor",
    # wiring and use
    "GraspPipeline": "pipeline",
    "SimulationStation": "stations.simulation",
    "MakePlanningModel": "planning_model",
    "Scenario": "scenario",
    "load_scenario": "scenario",
    "build_world": "world",
    "run_episode": "episode",
    "choose_on_view": "choose",
    # errors
    "TogError": "errors",
    "InputError": "errors",
    "EpisodeError": "errors",
}

__all__ = list(_MODULE_OF)


def __getattr__(name: str) -> Any:
    if name not in _MODULE_OF:
        raise AttributeError(f"module 'tog_drake' has no attribute {name!r}")
    return getattr(import_module(f"tog_drake.{_MODULE_OF[name]}"), name)


def __dir__() -> list[str]:
    return sorted(__all__)
