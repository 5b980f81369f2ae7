"""From a look at the hammer to the grasp that a model which really looks has asked for.

The model is ``seeing_server``: all that it knows is what it is sent. That it picks the right part
shows that pictures, marks, words and coordinates can be understood.
"""

import functools
from dataclasses import dataclass

import pytest
from pydrake.perception import PointCloud
from pydrake.systems.analysis import Simulator
from seeing_server import see_and_answer
from vlm_server import KEY, KEY_VARIABLES, VlmServer

from tog_drake.candidates import CandidatesConfig, pick_candidates
from tog_drake.episode import build_world
from tog_drake.judge import COMPLIANT_SHARE
from tog_drake.scenario import load_scenario
from tog_drake.selectors.strategies import STRATEGIES
from tog_drake.selectors.vlm.selector import Vlm, VlmSelector
from tog_drake.selectors.vlm.specification import read_specification
from tog_drake.values import Candidates, View, Workspace

HAND, USE = "hand me the hammer", "use the hammer to drive a nail"
PART = {HAND: "head", USE: "handle"}
MODELS = {"openai": "any", "gemini": "gemini-3.8-flash", "anthropic": "claude-sonnet-5-5"}
FAMILY = {"openai": "pixels", "gemini": "gemini", "anthropic": "pixels"}
K = 6  # the K of highest silhouette is 2 here, and both are grasps of the handle


@dataclass(frozen=True)
class Looked:
    """One look at the hammer."""

    view: View
    cloud: PointCloud
    candidates: Candidates
    parts: list[dict[tuple[str, str], float]]  # what each grasp closes on, by the labels


@pytest.fixture(scope="module")
def looked():
    world = build_world(load_scenario("Hammer"))
    simulator = Simulator(world.diagram)
    context = simulator.get_mutable_context()
    world.diagram.GetInputPort("task").FixValue(context, HAND)
    simulator.AdvanceTo(world.pipeline.executor.look_time)
    inner = world.pipeline.GetMyContextFromRoot(context)
    view, cloud, grasps = (
        world.pipeline.GetOutputPort(port).Eval(inner)
        for port in ("view", "cloud", "feasible_grasps")
    )
    query = world.station.GetOutputPort("cheat.query_object")
    parts = world.labels.closing_region(
        grasps, query.Eval(world.station.GetMyContextFromRoot(context))
    )
    return Looked(view, cloud, pick_candidates(grasps, CandidatesConfig(k=K), seed=0), parts)


@pytest.fixture(autouse=True)
def keys(monkeypatch):
    monkeypatch.delenv("GOOGLE_API_KEY", raising=False)
    for variable in KEY_VARIABLES.values():
        monkeypatch.setenv(variable, KEY)


def seeing(family="pixels"):
    return VlmServer(functools.partial(see_and_answer, family=family))


def select(looked, specification, task, *, profile=None, seed=0, **settings):
    """The choice of a selector that asks a model, and the share of it on the part for the task."""
    model = read_specification(specification, profile=profile)
    selector = VlmSelector(Vlm(model=model, **settings), Workspace(), seed=seed)
    choice = selector.select(looked.view, looked.cloud, looked.candidates, task)
    return choice, looked.parts[choice.index].get(("hammer", PART[task]), 0.0)


@pytest.mark.parametrize("provider", MODELS)
@pytest.mark.parametrize("strategy", STRATEGIES)
def test_every_strategy_finds_the_part_for_the_task_through_every_protocol(
    looked, strategy, provider
):
    points = strategy in ("cpg", "avoid")  # for these paper takes the nearest contact alone
    task = USE if provider == "anthropic" else HAND
    rendering = "marked" if provider == "openai" or points else "paper"
    with seeing(FAMILY[provider]) as server:
        choice, share = select(
            looked,
            server.specification(provider, MODELS[provider]),
            task,
            strategy=strategy,
            rendering=rendering,
        )
    assert (choice.status, choice.fallback) == ("ok", None)
    assert all(exchange.status == "ok" for exchange in choice.exchanges), choice.exchanges
    assert share >= COMPLIANT_SHARE
