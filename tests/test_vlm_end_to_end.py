"""From a look at the hammer to the grasp that a model which really looks has asked for.

The model is ``seeing_server``: all that it knows is what it is sent. That it picks the right part
shows that pictures, marks, words and coordinates can be understood.
"""

import functools
import json
from dataclasses import dataclass

import numpy as np
import pytest
from command import tog
from pydrake.perception import PointCloud
from seeing_server import FAMILIES, see_and_answer
from vlm_server import KEY, KEY_VARIABLES, VlmServer, hang, says

from tog_drake.decision import decide
from tog_drake.errors import NoChoice
from tog_drake.judge import COMPLIANT_SHARE
from tog_drake.record import new_record
from tog_drake.scenario import load_scenario
from tog_drake.selectors.strategies import STRATEGIES
from tog_drake.selectors.vlm.selector import Vlm, VlmSelector
from tog_drake.selectors.vlm.specification import read_specification
from tog_drake.values import Candidates, View, Workspace
from tog_drake.world import build_world, look

HAND, USE = "hand me the hammer", "use the hammer to drive a nail"
PART = {HAND: "head", USE: "handle"}
MODELS = {"openai": "any", "gemini": "gemini-3.8-flash", "anthropic": "claude-sonnet-5-5"}
FAMILY = {"openai": "pixels", "gemini": "gemini", "anthropic": "pixels"}


@dataclass(frozen=True)
class Looked:
    """One look at the hammer."""

    view: View
    cloud: PointCloud
    candidates: Candidates
    parts: list[dict[tuple[str, str], float]]  # what each grasp closes on, by the labels


@pytest.fixture(scope="module")
def looked():
    scenario = load_scenario("Hammer")
    world = build_world(scenario)
    context = look(world, scenario, HAND).get_context()
    inner = world.pipeline.GetMyContextFromRoot(context)
    view, cloud, candidates = (
        world.pipeline.GetOutputPort(port).Eval(inner) for port in ("view", "cloud", "candidates")
    )
    query = world.station.GetOutputPort("cheat.query_object")
    parts = world.labels.closing_region(
        candidates.grasps, query.Eval(world.station.GetMyContextFromRoot(context))
    )
    return Looked(view, cloud, candidates, parts)


@pytest.fixture(autouse=True)
def keys(monkeypatch):
    monkeypatch.delenv("GOOGLE_API_KEY", raising=False)
    for variable in KEY_VARIABLES.values():
        monkeypatch.setenv(variable, KEY)


def seeing(family="pixels"):
    return VlmServer(functools.partial(see_and_answer, family=family))


def select(looked, specification, task, *, profile=None, **settings):
    """The choice of a selector that asks a model, and the share of it on the part for the task."""
    model = read_specification(specification, profile=profile)
    selector = VlmSelector(Vlm(model=model, **settings), Workspace(), seed=0)
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


@pytest.mark.parametrize("family", FAMILIES)
def test_a_model_that_points_in_the_way_of_its_family_is_understood(looked, family):
    with seeing(family) as server:
        specification = server.specification("openai")
        choice, share = select(looked, specification, HAND, profile=family, strategy="avoid")
    assert choice.status == "ok"
    assert share >= COMPLIANT_SHARE


SPOILED = {
    "shifted reference": lambda plain, marked: (np.roll(plain, 12, axis=1), marked),
    "blue for red": lambda plain, marked: (plain[..., ::-1], marked[..., ::-1]),
    "head cut off": lambda plain, marked: (plain[:, 200:], marked[:, 200:]),
    "reference of another size": lambda plain, marked: (plain[::2, ::2], marked),
    "no marks": lambda plain, marked: (plain, plain),
}


@pytest.mark.parametrize("spoiled", SPOILED)
def test_pictures_that_cannot_be_understood_get_no_answer(looked, spoiled):
    sent = []

    def answer(text, images):
        pictures = SPOILED[spoiled](*images)
        sent.append(see_and_answer(text, [np.ascontiguousarray(p) for p in pictures]))
        return sent[-1]

    with VlmServer(answer) as server, pytest.raises(NoChoice):
        select(looked, server.specification("openai"), HAND, strategy="gsi")
    assert all(said.startswith("I cannot answer") for said in sent), sent


def run(folder, *arguments, strategy, status=0):
    """Runs ``tog run`` on the hammer and returns its record."""
    options = ["--task", HAND, "--strategy", strategy, "--no-meshcat", "--out", folder]
    done = tog("run", *options, *arguments)
    assert done.status == status, done
    return json.loads((folder / "episode.json").read_text())


def test_a_run_lifts_the_hammer_by_its_head_and_is_decided_alike_from_its_cassette(tmp_path):
    cassette = tmp_path / "asked.jsonl"
    with seeing() as server:
        model = ["--vlm", server.specification("openai"), "--record", cassette]
        record = run(tmp_path, *model, strategy="gsi")
        assert len(server.received) == 1
    assert (record["outcome"], record["task_compliance"]) == ("lifted", True)
    assert record["held"] == {"head": 1.0}

    scenario = load_scenario("Hammer")  # another world, and no server
    scenario.pipeline.selector = Vlm(strategy="gsi", replay=str(cassette))
    world = build_world(scenario)
    again = decide(world.pipeline, look(world, scenario, HAND).get_context())
    replayed = new_record(again, scenario.pipeline, task=HAND, seed=scenario.random_seed)
    assert replayed["choice"] == record["choice"]  # bit for bit: floats are written in full
    assert [e.pop("replayed") for e in replayed["vlm"]["exchanges"]] == [str(cassette)]
    assert [e.pop("replayed") for e in record["vlm"]["exchanges"]] == [None]
    assert replayed["vlm"] == {**record["vlm"], "model": f"replay:{cassette}"}


def test_where_the_server_hangs_a_run_goes_on_with_the_geometric_selector_and_says_so(tmp_path):
    with seeing() as server:
        server.misbehave(hang, always=True)
        hasty = "pipeline: {selector: !Vlm {deadline: 0.3}}"
        model = ["--vlm", server.specification("openai"), "--scenario-text", hasty]
        record = run(tmp_path, *model, strategy="cpg")
    assert (record["vlm"]["status"], record["vlm"]["fallback"]) == ("timed_out", "geometric")
    assert "so the geometric selector chose" in record["choice"]["reason"]
    assert (record["outcome"], record["task_compliance"]) == ("lifted", True)


def test_where_the_model_refuses_a_run_that_may_not_fall_back_ends_without_a_choice(tmp_path):
    with seeing() as server:
        server.misbehave(says(text=None, refusal="I do not grasp things."), always=True)
        model = ["--vlm", server.specification("openai"), "--fallback", "fail"]
        record = run(tmp_path, *model, strategy="cpg", status=1)
    assert (record["outcome"], record["choice"]) == ("no_choice", None)
    assert (record["vlm"]["status"], record["vlm"]["fallback"]) == ("refused", None)
    assert "I do not grasp things." in record["message"]
