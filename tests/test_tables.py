import random

import pytest
from hypothesis import given
from hypothesis import strategies as st
from run_folder import make_exchange, make_line, make_vlm

from tog_drake.benchmark.costs import cost_rows
from tog_drake.benchmark.failures import failure_rows, fingers_and_pads, motion_rows, rejection_rows
from tog_drake.benchmark.statistics import Rate, mcnemar, wilson
from tog_drake.benchmark.tables import (
    candidate_rows,
    in_table_order,
    methods_of,
    paired_rows,
    success_rows,
    view_rows,
)
from tog_drake.benchmark.view_sheets import view_sheets
from tog_drake.record import chosen_region


def by_group(rows):
    return {(row["method"], row["group"]): row for row in rows}


def blind(number, task, *, seed=0, complies=True, outcome="lifted", method="top-score"):
    """A line of an episode that serves two tasks."""
    return make_line(
        number, outcome, complies=complies, method=method, selector=method, seed=seed, task=task,
        tasks=2, name=f"{method}-{seed}", category="use" if task == "use" else "handover",
    )  # fmt: skip


def test_intervals_are_wilsons():
    # Worked by hand: (p + z²/2n ± z √(p(1−p)/n + z²/4n²)) / (1 + z²/n), p = 0.9, n = 10, z = 1.96.
    assert wilson(9, 10) == pytest.approx((0.5958, 0.9821), abs=1e-4)
    assert wilson(10, 10)[1] == 1.0
    assert wilson(0, 10)[0] == 0.0


def test_nothing_judged_has_no_rate():
    assert (Rate(0, 0).value, Rate(0, 0).interval) == (None, None)
    assert Rate(1, 4).value == 0.25


@pytest.mark.parametrize(
    ("only_first", "only_second", "p"),
    [
        (0, 0, 1.0),
        (5, 0, 2 / 32),  # twice the chance that a coin falls five times on one side
        (1, 8, 2 * (1 + 9) / 512),  # 9 throws: twice P(0 or 1)
        (3, 3, 1.0),
    ],
)
def test_mcnemars_test_is_that_of_a_fair_coin(only_first, only_second, p):
    assert mcnemar(only_first, only_second) == pytest.approx(p)
    assert mcnemar(only_second, only_first) == pytest.approx(p)


def test_rates_are_shares_of_all_episodes_in_each_category_and_in_all():
    lines = [
        make_line(0),
        make_line(1, complies=False, seed=1),
        make_line(2, "slipped", category="handover"),
        make_line(3, "no_grasp", category="handover", seed=1),
        make_line(4, category="choose"),
    ]
    rows = by_group(success_rows(lines))
    assert [group for _, group in rows] == ["use", "handover", "choose", "all"]
    use = rows["oracle", "use"]
    assert {k: use[k] for k in ("n", "tasks", "grasp", "task", "both", "both_successes")} == {
        "n": 2, "tasks": 2, "grasp": 1.0, "task": 0.5, "both": 0.5, "both_successes": 1
    }  # fmt: skip
    everything = rows["oracle", "all"]  # without "choose", which the paper has not
    assert (everything["n"], everything["grasp"], everything["both"]) == (4, 0.5, 0.25)
    assert (everything["both_low"], everything["both_high"]) == wilson(1, 4)
    assert everything["failures"] == "1 slipped, 1 no_grasp"


@pytest.mark.parametrize("by", ["scenario", "object", "task"])
def test_rates_are_told_by_other_groups_too(by):
    lines = [make_line(0, **{by: "b"}), make_line(1, "slipped", **{by: "a"})]
    rows = success_rows(lines, by)
    assert [(row["group"], row["grasp"]) for row in rows] == [("a", 0.0), ("b", 1.0)]


def test_what_no_hand_can_hold_counts_and_is_listed_apart():
    lines = [make_line(0), make_line(1, "no_choice", seed=1, beyond="it is too wide")]
    rows = by_group(success_rows(lines))
    assert rows["oracle", "all"]["both"] == 0.5
    assert rows["oracle", "all that 8 cm can hold"]["both"] == 1.0
    assert ("oracle", "all that 8 cm can hold") not in by_group(success_rows(lines[:1]))


def test_the_chosen_grasp_is_judged_apart_from_what_the_pads_hold():
    lines = [
        make_line(0, chosen_closes_on={"head": 1.0}),
        make_line(1, "slipped", seed=1, chosen_closes_on={"handle": 0.8, "head": 0.2}),
        make_line(2, "no_choice", seed=2, chosen_closes_on=None, closes_on=None, choice=None),
        make_line(3, "no_plan", seed=3, closes_on=None),
    ]
    row = by_group(success_rows(lines))["oracle", "all"]
    assert (row["chosen_successes"], row["task_successes"], row["tasks"]) == (2, 1, 4)


def test_a_line_of_an_older_run_says_of_the_chosen_grasp_no_more_than_it_knows():
    def older(number, planned):
        line = make_line(number, seed=number)
        del line["record"]["chosen_closes_on"]
        line["record"]["choice"]["planned_index"] = planned
        return line

    regions = [chosen_region(older(i, planned)["record"]) for i, planned in enumerate((4, 2, None))]
    assert regions == [{"handle": 1.0}, None, None]
    row = by_group(success_rows([older(0, 4), older(1, 2)]))["oracle", "all"]
    assert (row["chosen_successes"], row["chosen_n"], row["tasks"]) == (1, 1, 2)


def test_an_episode_that_serves_two_tasks_is_one_grasp():
    lines = [
        blind(0, "use"),
        blind(0, "hand", complies=False),
        blind(1, "use", seed=1, outcome="empty"),
        blind(1, "hand", seed=1, outcome="empty"),
    ]
    row = by_group(success_rows(lines))["top-score", "all"]
    assert (row["n"], row["tasks"], row["grasp"], row["both"]) == (2, 4, 0.5, 0.25)
    assert row["failures"] == "1 empty"


def test_a_task_that_says_nothing_of_parts_is_not_judged_but_a_broken_episode_is():
    silent = {"allowed": None, "task_compliance": None, "combined_success": None}
    broken = make_line(1, "broken", seed=1, chosen_closes_on=None, **silent)
    lines = [make_line(0, **silent), broken]
    row = by_group(success_rows(lines))["oracle", "all"]
    assert (row["n"], row["grasp"], row["tasks"], row["task"]) == (2, 0.5, 1, 0.0)
    row = by_group(success_rows(lines[:1]))["oracle", "all"]
    assert (row["tasks"], row["task"], row["both_low"]) == (0, None, None)


def asked(number, outcome, status, fallback=None):
    vlm = make_vlm([], status=status, fallback=fallback)
    return make_line(number, outcome, seed=number, method="vlm", selector="vlm", vlm=None) | {
        "record": make_line(number, outcome)["record"] | {"vlm": vlm}
    }


def test_answers_that_cannot_be_read_are_failures_and_told():
    failed = [asked(i, "no_choice", s) for i, s in enumerate(("refused", *["unreadable"] * 2))]
    lines = [*failed, asked(3, "slipped", "ok"), asked(4, "lifted", "ok")]
    row = by_group(success_rows(lines))["vlm", "all"]
    assert row["failures"] == "3 no_choice (unreadable 2, refused 1), 1 slipped"
    assert (row["n"], row["grasp_successes"], row["task_successes"]) == (5, 1, 1)
    replaced = [asked(i, o, "empty", "geometric") for i, o in enumerate(("lifted", "slipped"))]
    row = by_group(success_rows(replaced))["vlm", "all"]
    assert row["failures"] == "1 slipped, by fallback 2 (empty 2)"


def test_two_methods_are_compared_on_the_trials_that_both_did():
    a = [make_line(i, o, seed=i) for i, o in enumerate(["lifted"] * 5 + ["empty", "lifted"])]
    outcomes = ["empty"] * 5 + ["empty"]  # its seed 6 was not run
    b = [make_line(10 + i, o, seed=i, method="b") for i, o in enumerate(outcomes)]
    grasp, _, both = paired_rows([*a, *b])
    assert grasp == {
        "first": "oracle", "second": "b", "rate": "grasp", "n": 6, "both": 0, "only_first": 5,
        "only_second": 0, "neither": 1, "p": pytest.approx(1 / 16),
    }  # fmt: skip
    assert both["only_first"] == 5
    assert paired_rows([*a, make_line(20, seed=99, method="b")]) == []


def test_a_method_that_reads_no_task_is_paired_task_by_task():
    reading = [make_line(i, task=task) for i, task in enumerate(("use", "hand"))]
    blind_ones = [blind(2, "use"), blind(2, "hand", complies=False)]
    both = next(r for r in paired_rows([*reading, *blind_ones]) if r["rate"] == "both")
    assert (both["n"], both["both"], both["only_first"]) == (2, 1, 1)
    other = [blind(3, task, method="random", outcome="empty") for task in ("use", "hand")]
    rows = {row["rate"]: row["n"] for row in paired_rows([*blind_ones, *other])}
    assert rows == {"grasp": 1, "task": 2, "both": 2}  # one grasp each, whatever it is judged for


def test_the_number_of_candidates_is_a_row_each_and_auto_tells_what_it_chose():
    def line(number, k, candidates, outcome="lifted"):
        counts = {"candidates": candidates}
        method = f"oracle k={k}"
        return make_line(number, outcome, k=k, method=method, seed=number, counts=counts)

    lines = [line(0, "10", 10), line(1, "2", 2, "empty"), line(2, "auto", 4), line(3, "auto", 4),
             line(4, "auto", 3), line(5, "auto", None, "no_grasp")]  # fmt: skip
    rows = candidate_rows([*lines, make_line(6, method="other", strategy="x", k="3")])
    assert [(row["base"], row["k"], row["both"]) for row in rows] == [
        ("oracle", "2", 0.0), ("oracle", "10", 1.0), ("oracle", "auto", 0.75)
    ]  # fmt: skip
    assert rows[-1]["chosen_k"] == {"3": 1, "4": 2, "none": 1}
    assert candidate_rows([make_line(0)]) == []


def test_failures_are_counted_by_outcome_and_reason():
    lines = [
        make_line(0, "no_choice", message="none of 284 grasps"),
        make_line(1, "no_choice", message="none of 12 grasps", object="mug"),
        make_line(2, complies=False, held={"head": 0.7, "body": 0.3}),
        make_line(3),
        blind(4, "use", complies=False),  # it was not told
        blind(5, "use", seed=1, outcome="slipped"),
        blind(5, "hand", seed=1, outcome="slipped"),
    ]
    rows = failure_rows(lines)
    assert [(f["outcome"], f["reason"], f["n"], f["objects"]) for f in rows] == [
        ("no_choice", "none of # grasps", 2, "hammer, mug"),
        ("lifted", "held by head and body", 1, "hammer"),
        ("slipped", "", 1, "hammer"),
    ]


def test_proposals_of_a_scene_are_counted_once_whoever_chose_among_them():
    lines = [make_line(0), make_line(1, method="other"), make_line(2, seed=1)]
    assert [(r["proposer"], r["reason"], r["n"], r["share"]) for r in rejection_rows(lines)] == [
        ("antipodal", "no_ik", 60, 0.3), ("antipodal", "hidden", 20, 0.1)
    ]  # fmt: skip


def test_like_motions_are_one():
    stops = {"note": "with stops, since 4 attempts to optimise failed: x"}
    lines = [make_line(0), make_line(1, motion=stops), make_line(2, motion=None)]
    assert [(row["note"], row["n"]) for row in motion_rows(lines)] == [
        ("optimised, attempt #", 1), ("with stops, since # attempts to optimise failed: x", 1)
    ]  # fmt: skip


def test_numbers_in_a_reason_are_left_out_but_not_those_in_a_name():
    says = "{} N on ycb_{}_mustard at {} s (attempt 3/5), after {}e-05 m; K2 is 0.5."
    messages = [says.format(31, "006", "2.25", 1), says.format(7, "006", "1.5", 3)]
    messages.append(says.format(7, "007", "1.5", 3))
    lines = [make_line(i, "empty", message=message) for i, message in enumerate(messages)]
    assert [(row["reason"], row["n"]) for row in failure_rows(lines)] == [
        ("# N on ycb_006_mustard at # s (attempt #/#), after # m; K2 is #.", 2),
        ("# N on ycb_007_mustard at # s (attempt #/#), after # m; K2 is #.", 1),
    ]


def test_labels_agree_where_the_part_between_the_fingers_is_the_one_that_is_held():
    clear, mixed = {"head": 0.9, "body": 0.1}, {"head": 0.6, "body": 0.4}
    lines = [
        make_line(0, held=clear, closes_on=clear),
        make_line(1, held=clear, closes_on={"body": 1.0}),
        make_line(2, held=mixed, closes_on=clear),
        make_line(3, "empty", closes_on=clear),
        make_line(4, held={"head": 0.52, "body": 0.48}, closes_on={"body": 1.0}),  # a tie
        make_line(5, held={"head": 0.6, "body": 0.4}, closes_on={"body": 1.0}),
    ]
    assert fingers_and_pads(lines) == {"n": 5, "agree": 3, "clear": 2, "clear_agree": 1, "mixed": 3}


def test_what_decisions_took_tells_live_questions_from_replayed_ones():
    live = [make_exchange(seconds=s) for s in (1.0, 3.0)]
    lines = [
        make_line(0, exchanges=live[:1], seconds={"decide": 1.0, "execute": 2.0}),
        make_line(1, exchanges=live, seconds={"decide": 3.0, "execute": None}),
        make_line(2, exchanges=[make_exchange(seconds=8.0, replayed="a.jsonl", cost=None)]),
        make_line(3, "no_grasp", seconds={"decide": 2.0, "execute": None}),
    ]
    (row,) = cost_rows(lines)
    assert (row["n"], row["decide"], row["execute"]) == (4, 1.5, 3.0)
    assert (row["live"], row["live_questions"], row["live_tokens"]) == (2, 3, 330)
    assert row["live_cost"] == pytest.approx(0.003)
    assert (row["live_model"], row["live_model_p95"]) == (2.5, pytest.approx(3.85))
    assert (row["replayed"], row["replayed_model"], row["replayed_cost"]) == (1, 8.0, None)


def test_the_parts_of_a_run_come_back_in_its_order():
    lines = [make_line(i, method=m) for i, m in enumerate("cab")]
    assert methods_of(lines[::-1]) == ["c", "a", "b"]
    assert in_table_order(lines[::-1]) == lines


def viewed(number, view, outcome="lifted", *, camera="wrist", visible=None, **changes):
    """A line of an episode with six candidates; the hand's camera is the first of ``visible``."""
    selection = {"camera": camera, "candidates_visible": visible or {"wrist": 6}}
    changes = {"method": f"vlm cpg m, view: {view}", "selector": "vlm", "strategy": "cpg",
               "vlm": "m", "view_selection": selection, "seed": number % 10} | changes  # fmt: skip
    return make_line(number, outcome, view=view, **changes)


def two_views():
    """Three trials in the hand's view and in that of coverage, which solves one more."""
    side = {"camera": "side_2", "visible": {"wrist": 2, "side_1": 3, "side_2": 5}}
    return [
        viewed(0, "hand", visible={"wrist": 2}),
        viewed(1, "hand", "slipped", visible={"wrist": 2}),
        viewed(2, "hand"),
        viewed(10, "coverage", **side),
        viewed(11, "coverage", **side),
        viewed(12, "coverage", visible={"wrist": 6, "side_1": 1}),
    ]


def test_the_hands_view_and_another_are_compared_on_the_same_trials():
    hand, other = view_rows(two_views()[::-1])
    assert (hand["view"], other["view"]) == ("hand", "coverage")
    assert hand["base"] == other["base"] == "vlm cpg m"
    assert (hand["both_successes"], other["both_successes"], hand["pairs"]) == (2, 3, {})
    pair = other["pairs"]["both"]
    assert (pair["n"], pair["only_first"], pair["only_second"], pair["p"]) == (3, 0, 1, 1.0)
    assert (hand["shows"], hand["other_view"], hand["views_n"]) == (pytest.approx(10 / 3), 0, 3)
    assert (other["candidates"], other["hand_shows"]) == (6, pytest.approx(10 / 3))
    assert (other["shows"], other["other_view"]) == (pytest.approx(16 / 3), 2)


def test_views_are_compared_only_with_the_hands_and_where_nothing_else_differs():
    lines = two_views()
    assert view_rows(lines[:3]) == view_rows(lines[3:]) == []
    of_another_k = [viewed(20 + i, "hand", k="2", method="vlm cpg m, K=2") for i in range(3)]
    assert view_rows(of_another_k + lines[3:]) == []
    assert [row["base"] for row in view_rows(of_another_k + lines)] == ["vlm cpg m"] * 2
    assert view_rows([make_line(0), make_line(1, seed=1)]) == []


def test_an_episode_without_candidates_and_an_old_record_say_nothing_of_what_was_in_view():
    lines = [
        viewed(0, "hand", "no_grasp", view_selection=None),
        viewed(1, "hand", counts={"proposed": 9, "candidates": 0}, visible={"wrist": 0}),
        viewed(2, "hand", visible={"side_1": 4}),  # no record of ours: the chosen is not among them
        make_line(3),
    ]
    for row in success_rows(lines):
        assert (row["shows"], row["hand_shows"], row["candidates"]) == (None, None, None)
        assert row["views_n"] == 0


def test_the_table_of_views_stands_beside_what_the_paper_published():
    (sheet,) = view_sheets(two_views())
    rows = [dict(zip(sheet.columns, row, strict=True)) for row in sheet.rows]
    hand, other, published, chosen = rows
    assert str(other["Grasp"]) == "1.000 [0.44, 1.00]"
    assert other["Grasp ±"] == "+0.333, p 1.000 (0 : 1 of 3)"
    assert hand["Grasp ±"] is None
    shown = [other[name] for name in ("Candidates", "In hand's view", "In chosen view")]
    assert shown == ["6.00", "3.33", "5.33"]
    assert (hand["Other view"], other["Other view"]) == ("0 of 3", "2 of 3")
    assert (published["View"], published["Task, as held"].value) == ("hand", 0.778)
    assert (chosen["View"], chosen["Task, as held"].of) == ("detector", "45/54")
    assert (chosen["Task, as held ±"], chosen["Grasp and task ±"]) == ("+0.055", "+0.074")
    assert chosen["Grasp"] is chosen["Grasp ±"] is None  # not published
    assert sheet.published == 2
    assert view_sheets(two_views()[:3]) == []


LINES = st.lists(
    st.builds(
        make_line,
        number=st.integers(0, 9),
        outcome=st.sampled_from(["lifted", "empty", "no_choice"]),
        complies=st.booleans(),
        method=st.sampled_from(["a", "b"]),
        k=st.sampled_from([None, "2", "auto"]),
        view=st.sampled_from([None, "hand", "coverage"]),
        category=st.sampled_from(["use", "choose"]),
        task=st.sampled_from(["x", "y"]),
    ),
    max_size=12,
    unique_by=lambda line: line["cell"]["number"],
)


@given(LINES, st.randoms(use_true_random=False))
def test_no_table_depends_on_the_order_in_which_episodes_ended(lines, order):
    shuffled = random.Random(order.random()).sample(lines, len(lines))
    for table in (success_rows, paired_rows, candidate_rows, view_rows, failure_rows,
                  rejection_rows, motion_rows, cost_rows, fingers_and_pads):  # fmt: skip
        assert table(shuffled) == table(lines)


@given(LINES)
def test_rates_lie_in_their_intervals_and_none_is_greater_than_what_it_is_part_of(lines):
    for row in success_rows(lines):
        for rate in ("grasp", "strict", "chosen", "task", "both"):
            assert 0 <= row[f"{rate}_low"] <= row[rate] <= row[f"{rate}_high"] <= 1
        assert row["both_successes"] <= min(row["grasp_successes"], row["task_successes"])


def test_an_episode_that_reads_no_task_is_one_trial_of_the_grasp_beside_one_that_does():
    lines = []
    for scene in range(6):
        for task in range(2):
            same = {"seed": scene, "task": f"task {task}"}
            blind = {"method": "random", "selector": "random", "name": f"r{scene}", "tasks": 2}
            lines.append(make_line(scene, **blind, **same))
            lines.append(make_line(10 + 2 * scene + task, "slipped", method="oracle", **same))
    (grasp,) = (row for row in paired_rows(lines) if row["rate"] == "grasp")
    assert (grasp["n"], grasp["only_first"], grasp["only_second"]) == (6, 6, 0)
    assert grasp["p"] == pytest.approx(2 * 0.5**6)
