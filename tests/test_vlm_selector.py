"""The selector that asks a model, against a server on this machine."""

import time
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from pydrake.perception import BaseField, Fields, PointCloud
from test_strategies import bar_scene, to_picture, without_middle
from vlm_server import KEY, Spoken, VlmServer, cut, hang, status

from tog_drake import http_post
from tog_drake.errors import InputError, NoChoice, NoGrasp
from tog_drake.pinhole import project
from tog_drake.pipeline import PipelineConfig, make_selector
from tog_drake.scenario import Scenario, parse_scenario
from tog_drake.selectors.vlm.gemini import Gemini
from tog_drake.selectors.vlm.openai import OpenAi
from tog_drake.selectors.vlm.selector import Vlm, VlmSelector
from tog_drake.values import Candidates, Workspace

SCENE = bar_scene(n=19)
HANG = 20.0  # [s] no measure of speed: without the deadline it would be minutes
TASK = "pick up the box"  # any part will do: the geometric selector can choose, too


def cloud_of(points):
    cloud = PointCloud(len(points), Fields(BaseField.kXYZs | BaseField.kRGBs | BaseField.kNormals))
    cloud.mutable_xyzs()[:] = points.T
    cloud.mutable_rgbs()[:] = np.array([[200], [0], [0]])
    cloud.mutable_normals()[:] = np.array([[0.0], [0.0], [1.0]])
    return cloud


def saying(*texts):
    """A server whose model says one text after the other, and then the last for ever."""
    left = list(texts)
    return VlmServer(lambda text, images: left.pop(0) if len(left) > 1 else left[0])


def config(server, **changes):
    model = OpenAi(model="any", base_url=server.base_url("openai"), max_tokens=500)
    return Vlm(**{"strategy": "cpsi", "rendering": "paper", "model": model, **changes})


def select(asking, task=TASK, candidates=SCENE.candidates, seed=3):
    selector = VlmSelector(asking, Workspace(), seed=seed)
    return selector.select(SCENE.view, cloud_of(SCENE.points), candidates, task)


@pytest.fixture(autouse=True)
def key(monkeypatch):
    monkeypatch.setenv("OPENAI_API_KEY", KEY)


def test_the_grasp_that_the_model_names_is_chosen_and_what_was_said_is_kept():
    with saying("It should be held there.\nFinal answer: red") as server:
        choice = select(config(server))
    (exchange,) = choice.exchanges
    assert choice.index == exchange.marks["red"]
    assert choice.index in SCENE.candidates.index
    assert (choice.status, choice.fallback) == ("ok", None)
    assert "red" in choice.reason
    assert (exchange.prompt, exchange.status) == ("cpsi/1", "ok")
    assert exchange.answer == "It should be held there.\nFinal answer: red"
    assert exchange.model == "served-model-1"
    assert set(exchange.tokens) >= {"input", "output"}
    assert exchange.cost is None  # nobody knows the price
    assert len(exchange.key) == 64
    assert exchange.text.startswith("[image 1]\n\n")
    assert f'Task: "{TASK}"' in exchange.text
    (received,) = server.received
    np.testing.assert_array_equal(received.images[0], exchange.images[0])
    assert exchange.text.endswith(received.text.splitlines()[-1])  # how to answer, too


@pytest.mark.parametrize(
    ("useless", "found"),
    [
        ("I like all of them.", "unreadable"),
        ("", "empty"),
        (Spoken("It is number 1", finish="length"), "truncated"),
        ("Final answer: 9", "out_of_range"),
        ("It is 1 or 2.", "ambiguous"),
    ],
)
def test_an_answer_that_cannot_be_read_is_asked_for_once_more(useless, found):
    with saying(useless, "Final answer: 3") as server:
        choice = select(config(server, strategy="gmi"))
    first, second = choice.exchanges
    assert choice.index == second.marks["3"] == first.marks["3"]
    assert (first.status, second.status) == (found, "ok")
    assert (first.prompt, second.prompt) == ("gmi/1", "repair/1")
    assert first.message in second.text
    assert choice.status == "ok"
    asked = [r.body["max_tokens"] for r in server.received]
    assert asked == ([500, 2000] if found == "truncated" else [500, 500])


def test_a_cut_connection_is_not_asked_again_with_more_tokens(monkeypatch):
    monkeypatch.setattr(http_post, "FIRST_DELAY", 0.0)
    with saying("Final answer: red") as server:
        server.misbehave(cut, always=True)
        with pytest.raises(NoChoice) as caught:
            select(config(server))
    assert caught.value.status == "unreachable"
    assert len(caught.value.exchanges) == 1
    assert {r.body["max_tokens"] for r in server.received} <= {500}


def test_what_was_cut_off_is_not_read_even_if_it_could_be():
    with (
        saying(Spoken("Final answer: red", finish="length")) as server,
        pytest.raises(NoChoice) as caught,
    ):
        select(config(server))
    assert caught.value.status == "truncated"


def test_it_is_asked_for_no_more_than_once_more():
    with (
        saying("Well.", "Hm.", "Final answer: green") as server,
        pytest.raises(NoChoice, match="asked again") as caught,
    ):
        select(config(server))
    assert len(server.received) == 2
    assert [exchange.answer for exchange in caught.value.exchanges] == ["Well.", "Hm."]
    assert caught.value.status == "unreadable"


def test_a_refusal_is_respected():
    refusal = Spoken(None, finish="refusal", refusal="This could hurt somebody.")
    with saying(refusal) as server, pytest.raises(NoChoice, match="could hurt") as caught:
        select(config(server))
    assert len(server.received) == 1
    assert caught.value.status == caught.value.exchanges[0].status == "refused"


CHOOSING = ("Final answer: {}", "I choose {}.", '{{"choice": "{}"}}', "{}", "{} is the best grasp.")
TALKING = (
    "I would reject {}.", "The {} grasp slips.", "Anything but {}.", "Final answer: not {}", "{}?",
    "Is it {}?", "{} is worst.", "I choose {}.\nFinal answer: none", "I see the {} one",
    '{{"grasp": "{}", "suitable": false}}', "If it were {}",
)  # fmt: skip


@settings(max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    form=st.sampled_from(CHOOSING + TALKING) | st.text('{}[]:,. "\n#', max_size=20),
    color=st.sampled_from(["red", "green", "blue"]),
)
def test_the_grasp_that_a_model_chooses_in_words_is_chosen_and_otherwise_none(form, color):
    said = form.format(color) if form in CHOOSING + TALKING else form
    with saying(said) as server:
        try:
            choice = select(config(server))
        except NoChoice as error:
            assert form not in CHOOSING
            assert error.status not in (None, "ok")
            assert error.exchanges[-1].status == error.status
        else:
            assert form in CHOOSING
            assert choice.index == choice.exchanges[-1].marks[color]


@pytest.mark.parametrize("finish", ["refusal", "stop", "length"])
def test_an_endless_answer_makes_no_endless_reason(finish):
    with saying(Spoken("x" * 200_000, finish=finish)) as server:
        choice = select(config(server, fallback="geometric"))
    assert choice.fallback == "geometric"
    assert len(choice.reason) < 2000
    assert all(len(exchange.message) < 1000 for exchange in choice.exchanges)
    assert all(len(exchange.text) < 5000 for exchange in choice.exchanges)


def test_without_a_policy_nothing_is_chosen_in_place_of_an_answer():
    with saying("no idea") as server, pytest.raises(NoChoice, match=r"cannot be used"):
        select(config(server, fallback=None))


def test_the_geometric_selector_steps_in_where_it_may_and_the_choice_says_so():
    with saying("no idea") as server:
        choice = select(config(server, fallback="geometric"))
    assert choice.fallback == "geometric"
    assert choice.status == "unreadable"
    assert "cannot be used (unreadable)" in choice.reason
    assert "There is one object" in choice.reason  # so the geometric selector explains itself
    assert len(choice.exchanges) == 2


def test_where_neither_can_choose_both_say_why():
    with saying("no idea") as server, pytest.raises(NoChoice) as caught:
        select(config(server, fallback="geometric"), task="frobnicate it")
    assert "unreadable" in str(caught.value)
    assert "geometric selector cannot choose either: " in str(caught.value)
    assert caught.value.status == "unreadable"
    assert len(caught.value.exchanges) == 2


def test_a_server_that_is_silent_costs_no_more_than_the_deadline():
    with VlmServer(lambda text, images: "red") as server:
        server.misbehave(hang, always=True)
        started = time.monotonic()
        with pytest.raises(NoChoice) as caught:
            select(config(server, deadline=0.3))
        assert time.monotonic() - started < HANG
    assert caught.value.status == "timed_out"
    (exchange,) = caught.value.exchanges
    assert exchange.answer is None
    assert len(exchange.key) == 64


def test_a_server_that_takes_no_question_is_no_choice_either():
    with VlmServer(lambda text, images: "red") as server:
        server.misbehave(status(404), always=True)
        with pytest.raises(NoChoice) as caught:
            select(config(server))
    assert caught.value.status == "rejected"


@pytest.mark.parametrize("strategy", ["gsi", "cpsi", "gmi", "cpmi"])
def test_two_votes_for_one_grasp_are_one_choice(strategy):
    """The model knows what it wants, whatever its mark."""
    wanted = []

    def answer(text, images):
        seed_marks = marks[len(wanted)]
        wanted.append(next(label for label, row in seed_marks.items() if row == 6))
        return f"Final answer: {wanted[-1]}"

    marks = [marks_of(strategy, permutation) for permutation in (0, 1)]
    with VlmServer(answer) as server:
        choice = select(config(server, strategy=strategy, votes=2))
    assert choice.index == 6
    assert wanted[0] != wanted[1]
    assert "same with permuted marks" in choice.reason
    assert len(choice.exchanges) == 2


def marks_of(strategy, permutation):
    from tog_drake.selectors.strategies import STRATEGIES

    seen = []

    def ask(question):
        seen.append(question.marks)
        return question.expects.labels[0]

    scene = replace(SCENE, task=TASK, permutation=permutation, rendering="paper")
    STRATEGIES[strategy](scene, ask)
    return seen[0]


def test_two_votes_for_two_grasps_are_none():
    with (
        saying("Final answer: red") as server,
        pytest.raises(NoChoice, match="two grasps") as caught,
    ):
        select(config(server, votes=2))
    first, second = caught.value.exchanges
    assert first.marks["red"] != second.marks["red"]
    assert caught.value.status == "disagreed"
    assert first.status == second.status == "ok"


@pytest.mark.parametrize("rendering", ["marked", "paper"])
def test_the_nearest_of_all_grasps_is_chosen_where_the_model_points(rendering):
    scene = replace(SCENE, rendering=rendering)
    target = 7  # no candidate
    assert target not in SCENE.candidates.index
    p_W = SCENE.candidates.grasps.p_WContact[target] * [1, 0, 0] + [0, 0, 0.03]

    def answer(text, images):
        x, y = to_picture(scene, images[0], p_W)
        return f'{{"reasoning": "", "points": [{{"x": {x:.0f}, "y": {y:.0f}, "label": "grasp"}}]}}'

    with VlmServer(answer) as server:
        choice = select(config(server, strategy="cpg", rendering=rendering))
    assert choice.index == target
    contacts = SCENE.candidates.grasps.p_WContact[:, 0]
    assert abs(contacts[choice.alternatives[0]] - contacts[target]) < 0.04
    (shown,) = project(np.array([p_W]), SCENE.view.intrinsics, SCENE.view.X_WC)
    assert choice.pointed.keys() == {"grasp"}
    assert choice.pointed["grasp"] == pytest.approx(tuple(shown), abs=0.6)  # told in whole pixels


def test_a_model_that_points_at_nothing_is_asked_once_more():
    x, y = to_picture(replace(SCENE, rendering="paper"), None, SCENE.points.mean(axis=0))
    there = f'[{{"x": {x:.0f}, "y": {y:.0f}, "label": "grasp"}}]'
    with saying('[{"x": 5, "y": 5, "label": "grasp"}]', there) as server:
        choice = select(config(server, strategy="cpg"))
    first, second = choice.exchanges
    assert (first.status, second.status, choice.status) == ("off_object", "ok", "ok")
    assert first.points == {"grasp": (5.0, 5.0)}
    assert second.prompt == "repair/1"
    assert "on no object" in second.text


def test_a_point_on_no_object_is_noted_with_the_answer_that_told_it():
    with (
        saying('[{"x": 5, "y": 5, "label": "grasp"}]') as server,
        pytest.raises(NoChoice, match="is on no object") as caught,
    ):
        select(config(server, strategy="cpg"))
    assert caught.value.status == "off_object"
    assert len(caught.value.exchanges) == 2
    for exchange in caught.value.exchanges:
        assert exchange.status == "off_object"
        assert "on no object" in exchange.message
        assert exchange.points == {"grasp": (5.0, 5.0)}


@pytest.mark.parametrize("fallback", ["fail", "geometric"])
def test_a_place_that_no_grasp_holds_is_a_status_of_its_own(fallback):
    scene = without_middle(replace(SCENE, rendering="marked"))

    def answer(text, images):
        x, y = to_picture(scene, images[0], (0.5, 0.0, 0.03))
        return f'[{{"x": {x:.0f}, "y": {y:.0f}, "label": "grasp"}}]'

    asking = {"strategy": "cpg", "rendering": "marked", "fallback": fallback}
    with VlmServer(answer) as server:
        try:
            told = select(config(server, **asking), candidates=scene.candidates)
        except NoChoice as error:
            told = error
    assert told.status == "no_grasp_on_part"
    assert "holds the place that the model points at" in str(getattr(told, "reason", told))
    assert told.exchanges[0].status == "ok"  # it is not the answer that is wrong
    assert isinstance(told, NoChoice) == (fallback == "fail")


def test_the_same_seed_asks_the_same_question_and_another_one_shuffles_anew():
    with saying("Final answer: red") as server:
        keys = [select(config(server), seed=seed).exchanges[0].key for seed in (1, 1, 2)]
    assert keys[0] == keys[1] != keys[2]


def test_what_was_recorded_is_replayed_bit_for_bit_without_model_or_server(tmp_path):
    cassette = str(tmp_path / "said.jsonl")
    with saying("hm", "Final answer: blue") as server:
        model = OpenAi(model="any", base_url=server.base_url("openai"))
        recorded = select(config(server, model=model, record=cassette))
    replayed = select(Vlm(strategy="cpsi", rendering="paper", replay=cassette))
    assert replayed.index == recorded.index
    assert replayed.alternatives == recorded.alternatives
    assert replayed.reason == recorded.reason
    for before, after in zip(recorded.exchanges, replayed.exchanges, strict=True):
        assert (before.key, before.answer, before.status) == (after.key, after.answer, after.status)
    with pytest.raises(InputError, match="no answer to"):
        select(Vlm(strategy="cpsi", rendering="paper", replay=cassette), task="another one")


def test_without_a_grasp_nobody_is_asked():
    with saying("red") as server, pytest.raises(NoGrasp):
        select(config(server), candidates=Candidates.empty())
    assert server.received == []


def test_without_a_task_nobody_is_asked():
    with saying("red") as server, pytest.raises(InputError, match="no words"):
        select(config(server), task=" ")
    assert server.received == []


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"strategy": "gpt"}, r"strategy: 'gpt'; valid: gsi, cpsi, gmi, cpmi, cpg, pivot, avoid"),
        ({"rendering": "photo"}, r"rendering: 'photo'; valid: marked, paper"),
        ({"votes": 3}, r"votes: 3; valid: 1, 2"),
        ({"votes": 2, "strategy": "cpg"}, r"votes: 2 .* cpg .* gsi, cpsi, gmi, cpmi"),
        ({"nearest": "finger"}, r"nearest: 'finger'; valid: contact, both"),
        ({"fallback": "first"}, r"fallback: 'first'; valid: fail, geometric"),
        ({"deadline": 0.0}, r"deadline: 0; valid: above 0"),
        ({"deadline": float("nan")}, r"deadline: nan; valid: above 0"),
        ({"record": "a", "replay": "b"}, r"record and replay are given; valid: one"),
        ({"model": None}, r"no model to ask: give --vlm openai:MODEL@URL \| gemini:MODEL"),
        ({"model": Gemini(model="")}, r"no model is named"),
        ({"model": OpenAi(model="my-own")}, r"'my-own'.*profile"),
    ],
)
def test_what_is_out_of_bounds_is_refused_before_anything_is_asked(changes, said):
    whole = Vlm(**{"model": OpenAi(model="any", base_url="http://127.0.0.1:9/v1"), **changes})
    with pytest.raises(InputError, match=said):
        make_selector(PipelineConfig(selector=whole), seed=0)


def test_a_scenario_says_strategy_and_model_by_tag():
    text = """
    pipeline:
      selector: !Vlm
        strategy: cpg
        votes: 1
        fallback: geometric
        model: !OpenAi {model: any, base_url: "http://127.0.0.1:9/v1"}
    """
    scenario = parse_scenario(text, "test", Scenario())
    selector = scenario.pipeline.selector
    assert (selector.strategy, selector.fallback, selector.rendering) == (
        "cpg", "geometric", "marked"
    )  # fmt: skip
    assert selector.model == OpenAi(model="any", base_url="http://127.0.0.1:9/v1")
    over = parse_scenario("pipeline: {selector: !Vlm {strategy: gmi}}", "test", scenario)
    assert over.pipeline.selector.strategy == "gmi"
    assert over.pipeline.selector.model == selector.model
    assert isinstance(make_selector(over.pipeline, seed=0), VlmSelector)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("!Vlm {model: !Gpt {model: x}}", r"unknown tag !Gpt; valid: !OpenAi, !Gemini"),
        ("!Vlm {strategies: cpg}", r"no field 'strategies' \(did you mean strategy\?\)"),
        ("!Vlm {export: tape.jsonl}", r"no field 'export'"),
        ("!Vlm {votes: many}", r"votes must be a whole number"),
        ("!Vlm {model: gpt-6}", r"model must be one of !OpenAi, .*, not 'gpt-6'"),
    ],
)
def test_a_slip_in_the_scenario_is_named_with_what_would_be_valid(text, said):
    with pytest.raises(InputError, match=said):
        parse_scenario(f"pipeline: {{selector: {text}}}", "test", Scenario())


@pytest.mark.parametrize("strategy", ["gmi", "gsi"])
def test_two_equal_grasps_are_told_apart_by_their_marks(strategy):
    same = SCENE.candidates.grasps.take(np.array([4, 4]))
    twins = Candidates(same, np.array([0, 1]), np.array([0, 1]))
    picked = set()
    for answer in ("1", "2"):
        with saying(f"Final answer: {answer}") as server:
            asking = config(server, strategy=strategy, rendering="marked")
            choice = select(asking, candidates=twins)
        assert choice.index == choice.exchanges[0].marks[answer]
        picked.add(choice.index)
    assert picked == {0, 1}


def test_a_single_candidate_is_asked_about_once_however_many_votes_there_are():
    alone = Candidates(SCENE.candidates.grasps.take(np.array([4])), np.array([0]), np.array([0]))
    with saying("Final answer: 1") as server:
        choice = select(config(server, strategy="gmi", votes=2), candidates=alone)
    assert len(server.received) == len(choice.exchanges) == 1
    assert (choice.index, choice.alternatives) == (0, ())
    assert "permuted" not in choice.reason


@pytest.mark.parametrize(
    ("rendering", "nearest", "rule"),
    [
        ("paper", None, "its contact is"),
        ("marked", None, "the farther of its two contacts is"),
        ("paper", "both", "the farther of its two contacts is"),
        ("marked", "contact", "its contact is"),
    ],
)
def test_which_contact_counts_is_a_setting_and_as_published_by_default_in_paper(
    rendering, nearest, rule
):
    scene = replace(SCENE, rendering=rendering)

    def answer(text, images):
        x, y = to_picture(scene, images[0], (0.5, 0.0, 0.03))
        return f'[{{"x": {x:.0f}, "y": {y:.0f}, "label": "grasp"}}]'

    with VlmServer(answer) as server:
        asking = config(server, strategy="cpg", rendering=rendering, nearest=nearest)
        assert rule in select(asking).reason


@pytest.mark.parametrize("strategy", ["gsi", "cpsi"])
def test_more_candidates_than_colours_are_refused_before_anything_is_rendered(strategy):
    model = OpenAi(model="any", base_url="http://127.0.0.1:9/v1")
    crowd = PipelineConfig(selector=Vlm(strategy=strategy, model=model))
    crowd.candidates.k = "20"
    with pytest.raises(InputError, match=r"20 candidates .*\(--k\) to at most 12.* gmi or cpmi"):
        make_selector(crowd, seed=0)
    crowd.selector.strategy = "gmi"
    assert isinstance(make_selector(crowd, seed=0), VlmSelector)


@pytest.mark.parametrize(
    ("profile", "rendering", "strategy", "width", "refused"),
    [
        ("gpt", "paper", "cpg", 2049, True),
        ("gpt", "paper", "avoid", 2049, True),
        ("gpt", "paper", "cpg", 2048, False),
        ("gpt", "marked", "cpg", 2049, False),
        ("gpt", "paper", "cpsi", 2049, False),  # no pixels are told
        ("gemini", "paper", "cpg", 2049, False),  # nor here
    ],
)
def test_a_view_too_large_for_a_model_that_tells_pixels_is_refused_with_what_to_do(
    profile, rendering, strategy, width, refused
):
    small = SCENE.view
    wide = replace(
        small,
        rgb=np.pad(small.rgb, ((0, 0), (0, width - 320), (0, 0))),
        depth=np.pad(small.depth, ((0, 0), (0, width - 320))),
        intrinsics=replace(small.intrinsics, width=width),
    )
    with saying("nothing of use") as server:
        model = OpenAi(model="any", base_url=server.base_url("openai"), profile=profile)
        asking = config(server, strategy=strategy, rendering=rendering, model=model)
        selector = VlmSelector(asking, Workspace(), seed=3)
        words = r"2049×240 .* profile gpt .* up to 2048 .*--rendering marked"
        with pytest.raises(InputError if refused else NoChoice, match=words if refused else None):
            selector.select(wide, cloud_of(SCENE.points), SCENE.candidates, TASK)
        assert (server.received == []) == refused


def test_a_model_is_asked_by_a_text_of_ones_own_and_the_choice_says_by_which(tmp_path):
    mine = tmp_path / "mine.j2"
    mine.write_text("Of {{ labels | join(' or ') }}, which for {{ task | quoted }}?")
    with saying("red") as server:
        choice = select(config(server, prompt=str(mine)))
    (exchange,) = choice.exchanges
    assert exchange.prompt.startswith("mine/")
    assert f'which for "{TASK}"?' in exchange.text
    with pytest.raises(InputError, match=r"mine\.j2|mine/.*'labels' is undefined"):
        VlmSelector(Vlm("cpg", prompt=str(mine), model=OpenAi("gpt-5")), Workspace(), seed=0)
