import json
from dataclasses import replace
from typing import get_type_hints

import numpy as np
import pytest
from pydrake.perception import PointCloud

from tog_drake.decision import Decision
from tog_drake.errors import NoChoice, NoFeasibleGrasp, NoGrasp, NoPlan, NoView
from tog_drake.pipeline import PipelineConfig, Random, TopScore
from tog_drake.record import (
    OUTCOMES,
    SCHEMA,
    EpisodeRecord,
    new_record,
    selector_name,
    stage_rows,
)
from tog_drake.selectors.vlm.openai import OpenAi
from tog_drake.selectors.vlm.selector import Vlm
from tog_drake.values import Candidates, Choice, Exchange, FeasibleGrasps, GraspMotion, Grasps
from tog_drake.vlm_record import MAX_ANSWER

STAGES = [
    "render", "cloud", "propose", "filter", "candidates", "choose_view", "select", "plan",
]  # fmt: skip


def _grasps(n, type_=Grasps):
    return type_(np.tile(np.eye(4), (n, 1, 1)), np.full(n, 0.03), np.ones(n), np.zeros((n, 3)))


def _decision():
    """Every stage gave something: 5 points, 4 grasps, 3 feasible, 2 candidates, 1 choice."""
    feasible = _grasps(3, FeasibleGrasps)
    feasible.rejected.update(no_ik=1)
    return Decision(
        cloud=PointCloud(5),
        grasps=_grasps(4),
        feasible_grasps=feasible,
        candidates=Candidates(feasible, np.array([0, 2]), np.array([0, 0, 1])),
        choice=Choice(
            index=2,
            grasp=_grasps(1),
            reason="why",
            pixel=(1.234567, 2.0),
            pointed={"grasp": (3.0, 4.567)},
        ),
        motion=replace(GraspMotion.still(), duration=6.0, phase_times={"lift": 2.0}, grasp_index=1),
        seconds=dict.fromkeys(STAGES, 0.1),
    )


def _record(decision, config=None):
    return new_record(decision, config or PipelineConfig(), task="use it", seed=7)


def _json(record):
    return json.loads(json.dumps(record, allow_nan=False))


def test_a_record_has_every_field_of_the_schema_in_its_order_and_is_json():
    record = _json(_record(_decision()))
    assert list(record) == list(get_type_hints(EpisodeRecord))
    assert (record["schema"], record["task"], record["seed"]) == (SCHEMA, "use it", 7)
    assert record["counts"] == {"points": 5, "proposed": 4, "feasible": 3, "candidates": 2}
    assert record["rejected"] == {"no_ik": 1}
    assert record["choice"] == {
        "index": 2, "planned_index": 1, "part": None, "reason": "why", "status": "ok",
        "pixel": [1.234567, 2.0], "pointed": {"grasp": [3.0, 4.567]}, "score": 1.0, "width": 0.03,
    }  # fmt: skip
    assert record["motion"] == {"duration": 6.0, "phases": {"lift": 2.0}, "note": ""}
    assert record["outcome"] == "chosen"


def test_the_weights_are_those_that_the_proposer_worked_with():
    assert "weights" not in _record(_decision())["proposer"]
    weights = {"file": "gone.pt", "note": "not the released checkpoint"}
    record = _record(replace(_decision(), weights=weights))
    assert _json(record)["proposer"]["weights"] == weights


def test_a_decision_that_was_not_executed_says_nothing_about_success():
    record = _record(_decision())
    successes = ("grasp_success", "task_compliance", "combined_success")
    assert [record[key] for key in successes] == [None, None, None]


def test_deciding_is_all_but_rendering_and_executing():
    seconds = _record(_decision())["seconds"]
    assert list(seconds) == [*STAGES, "decide", "execute"]
    assert seconds["decide"] == pytest.approx(0.7)
    assert seconds["execute"] is None


@pytest.mark.parametrize(
    ("error", "outcome"),
    [
        (NoGrasp("nothing there"), "no_grasp"),
        (NoFeasibleGrasp("none", {"no_ik": 4}), "no_grasp"),
        (NoChoice("unsure"), "no_choice"),
        (NoView("no server"), "no_view"),
        (NoPlan("blocked"), "no_plan"),
    ],
)
def test_an_early_end_has_a_typed_outcome_with_its_message_and_no_verdict(error, outcome):
    record = _json(_record(Decision(error=error, seconds={"render": 0.2, "cloud": 0.1})))
    assert (record["outcome"], record["message"]) == (outcome, str(error))
    assert outcome in OUTCOMES
    assert record["grasp_success"] is record["combined_success"] is None  # nothing was executed
    assert record["choice"] is None
    assert record["counts"]["candidates"] is None


def test_stages_that_did_not_run_keep_their_place_as_null():
    record = _record(Decision(error=NoGrasp("x"), seconds={"render": 0.2, "cloud": 0.1}))
    assert list(record["seconds"]) == [*STAGES, "decide", "execute"]
    assert record["seconds"]["plan"] is None
    assert [row[0] for row in stage_rows(record)] == ["render", "cloud", "decide"]


def test_rejections_are_kept_when_nothing_is_left():
    decision = Decision(grasps=_grasps(4), error=NoFeasibleGrasp("none", {"no_ik": 3, "arm": 1}))
    record = _record(decision)
    assert record["rejected"] == {"no_ik": 3, "arm": 1}
    assert (record["counts"]["proposed"], record["counts"]["feasible"]) == (4, 0)


def test_alternatives_are_recorded_as_the_command_spells_them_with_their_settings():
    record = _record(_decision(), PipelineConfig(selector=TopScore()))
    assert record["selector"] == {"kind": "top-score"}
    assert record["proposer"]["kind"] == "antipodal"
    assert record["proposer"]["max_grasps"] == PipelineConfig().proposer.max_grasps
    assert _record(_decision(), PipelineConfig(selector=Random()))["selector"]["kind"] == "random"


def test_the_short_table_says_of_each_stage_how_many_and_how_long():
    rows = stage_rows(_record(_decision()))
    assert [row[0] for row in rows] == [*STAGES, "decide"]
    assert [row[1] for row in rows if row[1]] == [
        "5 points", "4 grasps", "3 feasible", "2 candidates"
    ]  # fmt: skip
    assert rows[0][2] == 0.1


def test_changing_a_record_leaves_the_decision_as_it_was():
    decision = _decision()
    record = _record(decision)
    record["rejected"]["no_ik"] = 99
    record["seconds"]["plan"] = 99.0
    assert decision.feasible_grasps.rejected == {"no_ik": 1}
    assert decision.seconds["plan"] == 0.1


def _exchange(**changes):
    return Exchange(
        **{
            "prompt": "gsi/1",
            "text": "[image 1]\n\nWhich?",
            "images": (np.zeros((2, 2, 3), np.uint8),),
            "marks": {"1": 2, "2": 0},
            "key": "ab" * 32,
            "answer": "1",
            "status": "ok",
            "message": "",
            "model": "served-1",
            "seconds": 0.51239,
            "tokens": {"input": 7, "output": 2},
            "cost": None,
            "points": {"grasp": (1.0 / 3.0, 0.125)},
            **changes,
        }
    )


ASKING = PipelineConfig(
    selector=Vlm(strategy="gsi", model=OpenAi(model="any", base_url="http://127.0.0.1:9/v1"))
)


def test_what_a_model_was_asked_and_said_is_in_the_record_without_the_images():
    decision = _decision()
    decision.choice = replace(decision.choice, exchanges=(_exchange(),))
    record = _json(_record(decision, ASKING))
    assert record["vlm"] == {
        "strategy": "gsi",
        "rendering": "marked",
        "model": "openai:any@http://127.0.0.1:9/v1",
        "seed": 7,
        "status": "ok",
        "fallback": None,
        "exchanges": [
            {
                "prompt": "gsi/1",
                "text": "[image 1]\n\nWhich?",
                "marks": {"1": 2, "2": 0},
                "key": "ab" * 32,
                "points": {"grasp": [1.0 / 3.0, 0.125]},
                "answer": "1",
                "status": "ok",
                "message": "",
                "model": "served-1",
                "seconds": 0.512,
                "tokens": {"input": 7, "output": 2},
                "cost": None,
                "replayed": None,
            }
        ],
    }
    assert record["attempts"][0]["exchanges"] == record["vlm"]["exchanges"]
    assert record["selector"]["kind"] == "vlm"
    assert record["selector"]["model"]["specification"] == "openai:any@http://127.0.0.1:9/v1"
    assert selector_name(record) == "vlm gsi openai:any@http://127.0.0.1:9/v1"


def test_who_chose_in_place_of_the_model_is_in_the_record():
    decision = _decision()
    decision.choice = replace(
        decision.choice,
        status="ambiguous",
        fallback="geometric",
        exchanges=(_exchange(status="ambiguous"),),
    )
    vlm = _record(decision, ASKING)["vlm"]
    assert (vlm["status"], vlm["fallback"]) == ("ambiguous", "geometric")


def test_of_a_failed_decision_too_the_record_tells_what_was_said():
    said = (_exchange(status="empty", answer=None, model=None, tokens=None),)
    error = NoChoice("it said nothing", status="empty", exchanges=said)
    record = _json(_record(Decision(error=error, seconds={"render": 0.2}), ASKING))
    assert record["vlm"]["status"] == record["vlm"]["exchanges"][0]["status"] == "empty"
    assert record["choice"] is None


def test_the_record_cuts_an_endless_answer():
    decision = _decision()
    decision.choice = replace(decision.choice, exchanges=(_exchange(answer="x" * 10**6),))
    (exchange,) = _record(decision, ASKING)["vlm"]["exchanges"]
    assert len(exchange["answer"]) == MAX_ANSWER


def test_where_no_model_is_asked_the_record_says_nothing_of_one():
    record = _record(_decision())
    assert record["vlm"] is None
    assert record["attempts"][0]["exchanges"] == []
    assert selector_name(record) == "geometric"


def test_a_replay_is_named_by_its_cassette():
    config = PipelineConfig(selector=Vlm(strategy="cpg", replay="said.jsonl"))
    assert _record(_decision(), config)["vlm"]["model"] == "replay:said.jsonl"
