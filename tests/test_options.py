"""Who chooses the grasp, as the command line says it."""

import inspect

import pytest
from command import refused, tog
from vlm_server import KEY_VARIABLES

from tog_drake.errors import InputError
from tog_drake.options import SelectorOptions
from tog_drake.pipeline import PipelineConfig
from tog_drake.selectors.geometric import Geometric
from tog_drake.selectors.strategies import STRATEGIES
from tog_drake.selectors.vlm.cassette import Cassette
from tog_drake.selectors.vlm.openai import OpenAi
from tog_drake.selectors.vlm.profiles import PROFILES
from tog_drake.selectors.vlm.recorded import Recorded
from tog_drake.selectors.vlm.selector import FALLBACKS, Vlm
from tog_drake.spread import spread

MODEL = "openai:any@http://127.0.0.1:9/v1"
RUN = ("run", "--no-meshcat", "--task", "use the hammer")
WITH_MODEL = (*RUN, "--vlm", MODEL)


@pytest.fixture(autouse=True)
def folder_without_keys(monkeypatch, tmp_path):
    for variable in KEY_VARIABLES.values():
        monkeypatch.delenv(variable, raising=False)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def applied(*, scenario=None, fallback=None, **options):
    config = PipelineConfig()
    if scenario is not None:
        config.selector = scenario
    SelectorOptions(**options).apply(config, fallback=fallback)
    return config.selector


def test_to_name_a_model_is_to_choose_by_it():
    selector = applied(vlm=MODEL, strategy="cpg", rendering="paper", fallback="geometric")
    assert isinstance(selector, Vlm)
    assert (selector.strategy, selector.rendering, selector.votes) == ("cpg", "paper", 1)
    assert selector.model == OpenAi(model="any", base_url="http://127.0.0.1:9/v1")
    assert selector.fallback == "geometric"  # where nobody says otherwise


def test_to_name_a_cassette_to_replay_is_to_choose_by_it_too(tmp_path):
    tape = tmp_path / "c.jsonl"
    question = Recorded("0" * 64, "/v1", {}, "gemini:gemini-9", "gemini", "gsi/1")
    Cassette(tape, "record").enter(question)
    assert applied(replay=tape) == applied(vlm=f"replay:{tape}") == Vlm(replay=str(tape))


def test_the_time_for_a_decision_can_be_limited():
    assert applied(vlm=MODEL, deadline=7.5).deadline == 7.5
    assert applied(scenario=Vlm(deadline=9.0), vlm=MODEL).deadline == 9.0


def test_what_is_not_given_stays_as_the_scenario_has_it():
    of_scenario = Vlm(strategy="cpmi", model=OpenAi("any"), votes=2, fallback="fail", deadline=7.0)
    of_scenario.model.base_url = "http://127.0.0.1:9/v1"
    selector = applied(scenario=of_scenario, rendering="paper", fallback="geometric")
    assert (selector.strategy, selector.votes, selector.deadline) == ("cpmi", 2, 7.0)
    assert (selector.rendering, selector.fallback) == ("paper", "fail")
    assert applied(scenario=of_scenario, profile="gemini").model.profile == "gemini"


def test_without_options_the_selector_is_the_scenario_s():
    assert applied() == Geometric()


def test_a_cassette_is_recorded_or_replayed_never_both(tmp_path):
    recorded = applied(vlm=MODEL, record=tmp_path / "a" / "new.jsonl")
    assert (recorded.record, recorded.replay) == (str(tmp_path / "a" / "new.jsonl"), None)
    assert list(tmp_path.iterdir()) == []  # nothing is written before something is asked
    (tmp_path / "old.jsonl").write_text("")
    of_scenario = Vlm(model=recorded.model, record="x.jsonl")
    replayed = applied(scenario=of_scenario, replay=tmp_path / "old.jsonl")
    assert (replayed.record, replayed.replay) == (None, str(tmp_path / "old.jsonl"))


def test_to_replay_leaves_the_model_that_the_scenario_has(tmp_path):
    (tmp_path / "old.jsonl").write_text("")
    model = OpenAi("any", "http://127.0.0.1:9/v1", max_tokens=777, effort="low")
    selector = applied(scenario=Vlm(model=model), vlm=f"replay:{tmp_path / 'old.jsonl'}")
    assert (selector.model, selector.replay) == (model, str(tmp_path / "old.jsonl"))


BAD = {
    "strategy alone": ((*RUN, "--strategy", "cpg"), ["--strategy", "--vlm openai:MODEL@URL"]),
    "record alone": ((*RUN, "--record", "c.jsonl"), ["--record", "--vlm"]),
    "votes of another selector": (
        (*RUN, "--selector", "random", "--votes", "2"), ["--votes", "Random", "--vlm"]
    ),
    "model of another selector": (
        (*WITH_MODEL, "--selector", "geometric"), ["--vlm", "Geometric"]
    ),
    "no model": ((*RUN, "--selector", "vlm"), ["--vlm", "replay:FILE"]),
    "profile of no model": (
        (*RUN, "--selector", "vlm", "--profile", "gemini"), ["--profile", "--vlm"]
    ),
    "deadline": ((*WITH_MODEL, "--deadline", "0"), ["deadline", "above 0"]),
    "deadline of another selector": ((*RUN, "--deadline", "5"), ["--deadline", "--vlm"]),
    "strategy": ((*WITH_MODEL, "--strategy", "gpsi"), ["'gpsi'", *STRATEGIES]),
    "rendering": ((*WITH_MODEL, "--rendering", "neon"), ["'neon'", "marked", "paper"]),
    "fallback": ((*WITH_MODEL, "--fallback", "guess"), ["'guess'", *FALLBACKS]),
    "profile": ((*WITH_MODEL, "--profile", "gemnii"), ["'gemnii'", *PROFILES]),
    "votes on points": (
        (*WITH_MODEL, "--strategy", "cpg", "--votes", "2"), ["votes", "cpg", "gsi"]
    ),
    "model that nobody knows": (
        (*RUN, "--vlm", "openai:my-model@http://127.0.0.1:9/v1"), ["'my-model'", *PROFILES]
    ),
    "model without its provider": ((*RUN, "--vlm", "gpt-6"), ["'gpt-6'", "openai:MODEL@URL"]),
    "key": ((*RUN, "--vlm", "anthropic:claude-opus-5-5"), ["ANTHROPIC_API_KEY"]),
    "record and replay": (
        (*WITH_MODEL, "--record", "a.jsonl", "--replay", "b.jsonl"),
        ["--record a.jsonl", "--replay b.jsonl"],
    ),
    "record of a replay": (
        (*RUN, "--vlm", "replay:b.jsonl", "--record", "a.jsonl"), ["a.jsonl", "b.jsonl"]
    ),
    "two cassettes": (
        (*RUN, "--vlm", "replay:b.jsonl", "--replay", "a.jsonl"), ["--replay", "replay:b.jsonl"]
    ),
    "profile of a cassette": (
        (*RUN, "--vlm", "replay:b.jsonl", "--profile", "gemini"), ["--profile", "b.jsonl"]
    ),
    "cassette that is not there": ((*RUN, "--vlm", "replay:none.jsonl"), ["none.jsonl"]),
    "cassette that is a folder": ((*WITH_MODEL, "--record", "."), ["--record .", "folder"]),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD)
def test_options_that_make_no_sense_are_one_line_with_what_would(case, tmp_path):
    arguments, words = BAD[case]
    refused(tog(*arguments), *words)
    assert list(tmp_path.iterdir()) == []


def test_a_cassette_below_a_file_cannot_be_written(tmp_path):
    (tmp_path / "taken").write_text("mine")
    refused(tog(*WITH_MODEL, "--record", "taken/c.jsonl"), "--record taken", "taken is a file")


def test_a_password_in_an_address_is_not_repeated():
    done = tog(*RUN, "--vlm", "openai:any@http://me:sesame-0123456789@127.0.0.1:9/v1")
    refused(done, "VLM_API_KEY")
    assert "sesame" not in done.err


@pytest.mark.parametrize("model", ["!Gemini {model: gemini-3.8-flash}", "!OpenAi {model: gpt-6}"])
def test_the_key_of_a_scenario_s_model_is_looked_for_before_a_run(model):
    text = f"pipeline: {{selector: !Vlm {{model: {model}}}}}"
    refused(tog(*RUN, "--scenario-text", text), "_API_KEY")


def test_choose_takes_the_same_options():
    view = ("--rgb", "a.png", "--depth", "a.npy", "--intrinsics", "a.json", "--task", "hold it")
    refused(tog("choose", *view, "--strategy", "cpg"), "--strategy", "--vlm")
    refused(tog("choose", *view, "--vlm", MODEL, "--strategy", "x"), "'x'", *STRATEGIES)


def test_a_selector_that_asks_a_model_needs_one():
    with pytest.raises(InputError, match="no model"):
        applied(selector="vlm")


def test_a_command_takes_its_options_together_and_typer_one_by_one():
    taken = []

    @spread(without=["selector", "fallback"])
    def command(*, out: str, options: SelectorOptions, seed: int = 0) -> None:
        taken.append((out, options, seed))

    parameters = inspect.signature(command).parameters
    fields = [f for f in SelectorOptions.__dataclass_fields__ if f not in ("selector", "fallback")]
    assert list(parameters) == ["out", *fields, "seed"]
    assert parameters["votes"].default is None
    assert parameters["out"].default is inspect.Parameter.empty
    command(out="o", seed=3, **{**dict.fromkeys(fields), "votes": 2})
    assert taken == [("o", SelectorOptions(votes=2), 3)]
