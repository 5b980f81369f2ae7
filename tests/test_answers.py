"""Whatever a model says is read as one of the labels, as a pixel, or not at all."""

import json
import re
from dataclasses import dataclass
from typing import get_args

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from tog_drake.errors import Unanswered
from tog_drake.selectors.vlm.answers import MAX_LENGTH, MAX_REASONING, instruction, read, schema
from tog_drake.selectors.vlm.profiles import PROFILES
from tog_drake.selectors.vlm.question import Options, Points
from tog_drake.values import AnswerStatus

NUMBERS = Options(("1", "2", "3", "4"))
COLORS = Options(("red", "green", "lime"))
ONE = Points(("grasp",), (640, 480))
TWO = Points(("grasp", "avoid"), (640, 480))


def _read(text, expects=NUMBERS, profile="pixels"):
    """The answer, or the status of there being none."""
    try:
        return read(text, PROFILES[profile], expects)
    except Unanswered as failure:
        assert failure.status in get_args(AnswerStatus)
        return failure.status


@pytest.mark.parametrize(
    ("said", "label"),
    [
        ("3", "3"),
        (" **3**.\n", "3"),
        ("03", "3"),
        ('{"reasoning": "1 is at the head, 2 beside it.", "choice": "3"}', "3"),
        ('{"reasoning": "It is not 1.", "choice": 3}', "3"),
        ('Sure!\n```json\n{"reasoning": "…", "choice": "3",}\n```\nAnything else, 1 or 2?', "3"),
        ("{'reasoning': 'python', 'choice': 3}", "3"),
        ('{"choice": [3]}', "3"),
        ('{"Choice": "grasp 3"}', "3"),
        ('First {"choice": "1"}. No, wait: it turns. {"choice": "3"}', "3"),
        ("1 is near the head. 2 is too low.\nFinal answer: 3", "3"),
        ("Final answer: 1\n\nLooking again, I correct myself.\n\n**Final Answer:** **3**", "3"),
        ("Final answer is: grasp 3. It lifts better than 1 does.", "3"),
        ("My answer is 3.", "3"),
        ("I compared 1, 2 and 4. The best of all is 3.", "3"),
        ("The hammer is 30 cm long, 0.95 sure, 80% or so. I choose candidate-3.", "3"),
        ("<think>1? 2! {'choice': 4}</think>\n3", "3"),
        ("no opening tag, so 1... </think> 3", "3"),
        ("<THINKING>1</THINKING>3", "3"),
        ("3 <think>or rather 1", "3"),
        ("<|begin_of_box|>3<|end_of_box|>", "3"),
        ("See [1] and {2}. I take [3].", "3"),
        ("The scores {'1': 0.2, '3': 0.9} are close. Final answer: 3", "3"),
    ],
)
def test_a_number_is_found_wherever_a_model_puts_it(said, label):
    assert _read(said) == label


@pytest.mark.parametrize(
    ("said", "label"),
    [
        ("Red", "red"),
        ('{"choice": "the green one"}', "green"),
        ("The blue handle lies on white ground. I choose the green grasp.", "green"),
        ("The reddish brown wood is held. Final answer: RED", "red"),
        ("Not red, it slips.\nI take green!", "green"),
        ("greenish", "unreadable"),
        ("blue", "out_of_range"),
        ('{"choice": "white"}', "out_of_range"),
        ("red or green", "ambiguous"),
        ("the lime green one", "ambiguous"),
    ],
)
def test_a_colour_counts_only_as_a_word_and_only_if_it_is_drawn(said, label):
    assert _read(said, COLORS) == label


@pytest.mark.parametrize(
    ("said", "status"),
    [
        ("", "empty"),
        (" \n\t", "empty"),
        ("<think>I see 3</think>", "empty"),
        ('{"choice": null}', "empty"),
        ('{"choice": []}', "empty"),
        ("There are none.", "empty"),
        ("None", "empty"),
        ("<think>I see 1, but 3 is better", "truncated"),
        ('{"reasoning": "1 is at the head, 3', "truncated"),
        ('Here:\n```json\n{"reasoning": "1 is at the head", "cho', "truncated"),
        ("I'm sorry, but I can't help with image 1.", "refused"),
        ("As an AI I have no hands.", "refused"),
        ("I cannot determine the answer between 1 and 2", "refused"),
        ("I'm not able to see any image 1 here.", "refused"),
        ("I can’t say", "unreadable"),
        ("The handle.", "unreadable"),
        ('{"choice": true}', "unreadable"),
        ('{"choice": 2.5}', "unreadable"),
        ('{"choice": {"x": 1}}', "unreadable"),
        ('{"choice": "the handle"}', "unreadable"),
        ('{"reasoning": "3 is best"}', "unreadable"),
        ('{"1": 0.9, "2": 0.1}', "unreadable"),
        ("1 or 2", "ambiguous"),
        ("Either is fine: 2/3", "ambiguous"),
        ("1-3", "ambiguous"),
        ("1,2 and 3", "ambiguous"),
        ('{"choice": [1, 2]}', "ambiguous"),
        ('{"choice": "1"} {"choice": "2"}', "ambiguous"),
        ('{"choice": "1 or 2"}', "ambiguous"),
        ("Final answer: 1 or 2", "ambiguous"),
        ("3 will not do", "ambiguous"),
        ("Don't take 3.", "ambiguous"),
        ("I choose 9, since 1 is blocked.", "ambiguous"),
        ("5", "out_of_range"),
        ("0", "out_of_range"),
        ("-3", "out_of_range"),
        ("−3", "out_of_range"),
        ('{"choice": "7"}', "out_of_range"),
        ('{"choice": -1}', "out_of_range"),
        ('{"choice": 1e400}', "unreadable"),
        (f'{{"choice": {"9" * 400}}}', "out_of_range"),
        ("Final answer: 12", "out_of_range"),
        ("2 is close. I choose 9.", "out_of_range"),
        ("word " * (MAX_LENGTH // 5 + 1), "too_long"),
        ("<think></think>" + "x" * MAX_REASONING + "3", "too_long"),
    ],
)
def test_what_is_no_label_for_sure_is_none(said, status):
    assert _read(said) == status


SIX = Options(("1", "2", "3", "4", "5", "6"))


@pytest.mark.parametrize(
    ("said", "status"),
    [
        ("Grasp 3 is nearest to the head.\nFinal answer: none of them", "empty"),
        ("Grasp 3 is nearest to the head.\nFinal answer: N/A", "empty"),
        ("Final answer: 3\nFinal answer:", "empty"),
        ("Grasp 3 is best. My answer is: neither.", "empty"),
        ('{"choice": "none of them, not even 3"}', "empty"),
        ("I choose 3.\nFinal answer: the handle", "unreadable"),
        ("I choose 3.\nFinal answer: 12", "out_of_range"),
        ("Final answer: -3", "out_of_range"),
        ("Of 6 grasps I choose the fourth.", "unreadable"),
        ("Grasp 2 is best. There are 4 grasps on the head.", "unreadable"),
        ("I choose 3. Confidence: 5", "unreadable"),
        ("I choose 3.\n5", "ambiguous"),
        ("Anything but 4.", "unreadable"),
        ("Final answer: anything but 4.", "unreadable"),
        ("I would reject grasp 4.", "unreadable"),
        ("Grasp 5 is worst.", "unreadable"),
        ("Final answer: 5 is the worst", "unreadable"),
        ("Final answer: 5 - that one is bad", "unreadable"),
        ("Please resend image 2.", "unreadable"),
        ("Step 1: look. Step 2: choose.", "unreadable"),
        ("Error 5", "unreadable"),
        ("Which of the 6 grasps do you mean?", "unreadable"),
        ("Do you mean 3?", "unreadable"),
        ("3?", "unreadable"),
        ("Final answer: 3?", "unreadable"),
        ("I choose 3 if it may be scratched.", "unreadable"),
        ("I choose 1 grasp.", "unreadable"),
        ("4 grasps", "unreadable"),
        ("You want me to end with the example final answer: 3", "unreadable"),
        ("I would be lying if I said that the answer is 3", "unreadable"),
        ("I do not think that the answer is 3", "unreadable"),
        ("Final answer: 3\nWait, none of them holds the handle.", "ambiguous"),
        ("Final answer: 3. On second thought I take another.", "ambiguous"),
        ("Final answer: 3. No: I choose 1.", "ambiguous"),
        ("Final answer: 3. For the handle, I choose 1.\nI choose 1.", "ambiguous"),
        ('{"choice": "3"} No, wait: it slips.', "ambiguous"),
        ('{"choice": "3"}\nI choose 1.', "ambiguous"),
        ('{"choice": "3"}\nFinal answer: none', "empty"),
        ("I choose 3.\nI choose 1.", "ambiguous"),
        ('{"grasp": 3, "suitable": false}', "unreadable"),
        ('{"number": 3, "unit": "grasps"}', "unreadable"),
        ('{"choice": "anything but 3"}', "unreadable"),
        ('{"reasoning": "I cannot see the image.", "choice": "3"}', "refused"),
        ("I don't have access to the images.\nFinal answer: 3", "refused"),
    ],
)
def test_a_number_that_is_rejected_counted_or_asked_about_is_not_chosen(said, status):
    assert _read(said, SIX) == status


@pytest.mark.parametrize(
    "said",
    [
        "Grasp 3 is best.",
        "I think grasp 3 is best.",
        "The best grasp for this task is number 3.",
        "Based on the image, the most suitable grasp is 3.",
        "Grasp 3 best fits the task.",
        "The robot should use grasp 3.",
        "Candidate 3 is the best option for handing over.",
        "Grasp 2 slips. So 3.",
        "Best: 3",
        "The head must stay free.\n\nBest grasp: 3",
        "The handle is free.\n\n3",
        "3 - the handle",
        "Therefore, I'd pick grasp 3.",
        "I would choose number 3, because its fingers close on the handle.",
        "I will go with **3**",
        "2 slips. My choice is [3].",
        "Grasp **3** is the best one.",
        "$\\boxed{3}$",
        "```\n3\n```",
        "Grasp 2 slips, so the answer is 3, on the handle.",
        "Final answer: 3 (the yellow handle)\nConfidence: high",
        "### Final Answer\n\n3",
        "Final answer:\n- 3",
        '{"reasoning": "on the handle", "grasp": 3}',
        '{"choice": "3"}\nFinal answer: 3. It does not touch the head.',
    ],
)
def test_a_choice_in_other_words_is_one(said):
    assert _read(said, SIX) == "3"


PROSE = (
    "Grasp {} is at the head.", "There are {} grasps.", "I would reject grasp {}.",
    "Anything but {}.", "Step {}: look.", "Confidence: {}", "Grasp {} is worst.", "Error {}",
    "Would you choose {}?", "Image {} is blurred.", "Of {} grasps I choose the first.",
    "Grasps 1 to {}:", "Choose which of {}?", "If it were cold, I choose {}.", "Not {}.",
    "The least bad is {}.", "It could be {}.", "{} of 6", "Nobody says that {} is the best.",
    "The head is not on {}", "Please resend image {}.", "\u201cI choose {}\u201d, you say.",
)  # fmt: skip
"""Sentences, and lines between others, that hold a number and choose nothing."""
SENTENCES = st.builds(str.format, st.sampled_from(PROSE), st.integers(1, 6))
TALK = st.lists(SENTENCES, min_size=2, max_size=5)


@given(said=TALK, between=st.sampled_from([" ", "\n", "\n\n"]))
def test_talk_about_grasps_chooses_none(said, between):
    assert _read(between.join(said), SIX) in get_args(AnswerStatus)


@given(said=TALK, label=st.sampled_from(SIX.labels))
def test_a_final_answer_counts_whatever_was_said_before(said, label):
    assert _read("\n".join([*said, f"Final answer: {label}"]), SIX) == label


@given(said=TALK, none=st.sampled_from(["none", "N/A", "", "none of the 6", "?", "the handle"]))
def test_a_final_answer_without_a_label_is_none_whatever_was_said_before(said, none):
    said = ["Final answer: 3", "I choose 3.", *said, f"Final answer: {none}"]
    assert _read("\n".join(said), SIX) in ("empty", "unreadable", "out_of_range")


CHOOSING = re.compile(r"(?i)choose|pick|take|best|choice|answer")


WORDS = (
    "1", "2", "3", "7", "-3", "grasp", "grasps", "the", "a", "of", "is", "best", "worst", "I",
    "choose", "reject", "take", "pick", "not", "none", "all", "there", "are", "but", "if", "final",
    "answer", "answer:", "Final", "is:", ".", "?", "!", ",", "\n", "(", ")", "{", "choice", "step",
    "or", "because", "since", "image", "confidence", "my", "first", "wait", "I choose",
    "Final answer:", "The best is", "\nMy answer is",
)  # fmt: skip


@given(words=st.lists(st.sampled_from(WORDS), min_size=1, max_size=9))
def test_what_is_read_from_any_words_was_said_to_be_chosen(words):
    text = " ".join(words)
    answer = _read(text, SIX)
    if answer in SIX.labels:
        assert answer in words
        last = re.split(r"[.!?](?=\s)|\n", text.rstrip(" .!\n"))[-1]
        before = re.findall(r"\w+", last.partition(answer)[0])
        assert CHOOSING.search(text) or set(before) <= {"the", "grasp", "image"}
        after = set(re.split(r"[.!]|\n", text.rpartition(answer)[2])[0].split())
        assert not {"reject", "not", "worst", "none", "but", "if", "?"} & after


def test_long_reasoning_does_not_make_an_answer_too_long():
    assert _read("<think>" + "1 or 2? " * (MAX_LENGTH // 4) + "</think>3") == "3"


@pytest.mark.parametrize(
    ("profile", "said"),
    [
        ("gemini", '[{"point": [500, 250], "label": "grasp"}]'),
        ("gemini", '```json\n[\n  {"point": [500, 250], "label": "handle of the mug"}\n]\n```'),
        ("gemini", '{"points": [{"point": [500, 250]}]}'),
        ("gemini", '{"reasoning": "I see it at [7, 9].", "point": [500, 250]}'),
        ("gemini", '{"box_2d": [480, 240, 520, 260], "label": "grasp"}'),
        ("gemini", "[500, 250]"),
        ("gemini", "[[500, 250]]"),
        ("gemini", '{"grasp": {"x": 250, "y": 500}}'),
        ("gemini", "{'point': [500, 250,], 'label': 'grasp'}"),
        ("gemini", 'Once {"point": [1, 1]}. Better: {"point": [500, 250]}. Not at [3, 4].'),
        ("gemini", '<think>[{"point": [1, 1]}]</think>{"point": [500, 250]}'),
        ("gemini", '[{"point": [500, 250], "label": "a"}, {"point": [500, 250], "label": "b"}]'),
        ("gemini", '[{"point": [500, 250], "label": "grasp"}, {"point": [1, 1], "label": "rim"}]'),
        ("qwen3-vl", '```json\n[{"point_2d": [250, 500], "label": "point_1"}]\n```'),
        ("qwen3-vl", '[{"bbox_2d": [200, 400, 300, 600]}]'),
        ("qwen2-vl", "<|box_start|>(200,400),(300,600)<|box_end|>"),
        ("qwen2-vl", "the handle(200,400),(300,600)"),
        ("internvl", "<ref>the handle</ref><box>[[200, 400, 300, 600]]</box>"),
        ("internvl", "[[200, 400, 300, 600]]"),
        ("glm-v", "<|begin_of_box|>[[200, 400, 300, 600]]<|end_of_box|>"),
        ("glm-v", "<|begin_of_box|>[250, 500]<|end_of_box|>"),
        ("molmo", 'It is here: <point x="25.0" y="50.0" alt="handle">handle</point>.'),
        ("molmo", '<points x1="25" y1="50" alt="handle">handle</points>'),
        ("molmo2", '<points coords="1 1 250 500">handle</points>'),
        ("molmo2", '<points label="handle" coords="1 1 250 500"/>'),
        ("robopoint", "[(0.25, 0.5)]"),
        ("robopoint", "grasp: (.25, .5)"),
        ("muse", '{"label": "grasp", "x_min": 200, "y_min": 400, "x_max": 300, "y_max": 600}'),
    ],
)
def test_a_point_is_found_as_its_family_writes_it(profile, said):
    assert _read(said, ONE, profile) == {"grasp": (159.5, 239.5)}


def test_qwen_may_write_tags_in_pixels_of_the_image_that_it_sees():
    said = '<points x1="321.5" y1="237.5" alt="handle">handle</points>'
    assert _read(said, ONE, "qwen2.5-vl") == {"grasp": (319.5, 239.5)}


@pytest.mark.parametrize(
    ("profile", "said", "status"),
    [
        ("gemini", "", "empty"),
        ("gemini", "[]", "empty"),
        ("gemini", '{"points": []}', "empty"),
        ("gemini", '{"reasoning": "nothing there", "point": null}', "empty"),
        ("molmo2", "There are none.", "empty"),
        ("gemini", "I can't assist with that.", "refused"),
        ("gemini", '[{"point": [500, 250], "la', "truncated"),
        ("gemini", "on the handle", "unreadable"),
        ("gemini", "at [320, 240] in the image", "unreadable"),  # pixels, perhaps
        ("gemini", "(500, 250)", "unreadable"),
        ("gemini", '<point x="25" y="50">handle</point>', "unreadable"),
        ("molmo", '[{"point": [25, 50]}]', "unreadable"),
        ("molmo", '<point x="25">handle</point>', "unreadable"),
        ("molmo", '<point x="25.0.1" y="50">handle</point>', "unreadable"),
        ("molmo2", '<points coords="1 1 250">handle</points>', "unreadable"),
        ("molmo2", '<points coords="1 a 250 500">handle</points>', "unreadable"),
        ("internvl", "<box>[[1, 2, 3]]</box>", "unreadable"),
        ("gemini", '{"point": ["500", "250"]}', "unreadable"),
        ("gemini", '{"point": [true, false]}', "unreadable"),
        ("gemini", '{"point": [NaN, 250]}', "unreadable"),
        ("gemini", '{"point": [Infinity, 250]}', "unreadable"),
        ("gemini", '{"point": [1e999, 250]}', "unreadable"),
        ("gemini", '{"point": [500, 250, 1]}', "unreadable"),
        ("gemini", f'{{"point": [{"9" * 400}, 250]}}', "unreadable"),
        ("pixels", '{"x": "320", "y": 240}', "unreadable"),
        ("gemini", '[{"point": [500, 250]}, {"point": [501, 250]}]', "ambiguous"),
        ("molmo", '<points x1="25" y1="50" x2="26" y2="50" alt="a">a</points>', "ambiguous"),
        ("molmo2", '<points coords="1 1 250 500 2 300 300">handles</points>', "ambiguous"),
        ("molmo2", '<points coords="1 1 250 500;2 1 300 300">handles</points>', "ambiguous"),
        ("robopoint", "[(0.25, 0.5), (0.3, 0.5)]", "ambiguous"),
    ],
)
def test_what_is_no_point_for_sure_is_none(profile, said, status):
    assert _read(said, ONE, profile) == status


@pytest.mark.parametrize(
    "label",
    ["do not grasp here", "avoid", "no suitable place", "don't touch", "grasp: not here", "not",
     "keep off", "Grasp (avoid)", "do_not_grasp"],
)  # fmt: skip
@pytest.mark.parametrize("expects", [ONE, TWO], ids=["one", "two"])
def test_a_label_that_speaks_against_a_place_does_not_make_it_the_one_to_grasp(label, expects):
    said = json.dumps([{"point": [500, 250], "label": label}, {"point": [9, 9], "label": "avoid"}])
    assert _read(said, expects, "gemini") == "ambiguous"
    if expects is ONE:
        assert _read(json.dumps({label: [500, 250]}), ONE, "gemini") == "ambiguous"
        said = f'<points coords="1 1 250 500">{label}</points>'
        assert _read(said, ONE, "molmo2") == "ambiguous"


GRASP, AVOID = (159.5, 239.5), (319.5, 119.5)


@pytest.mark.parametrize(
    ("profile", "said"),
    [
        (
            "gemini",
            '[{"point": [250, 500], "label": "avoid"}, {"point": [500, 250], "label": "grasp"}]',
        ),
        ("gemini", '{"grasp": [500, 250], "avoid": [250, 500]}'),
        ("gemini", '{"grasp": {"point": [500, 250]}, "avoid": {"point": [250, 500]}}'),
        (
            "gemini",
            '[{"point": [500, 250], "label": "grasp: handle"},'
            ' {"point": [250, 500], "label": "avoid (blade)"}]',
        ),
        (
            "gemini",
            '{"point": [500, 250], "label": "Grasp point"},'
            ' {"point": [250, 500], "label": "AVOID"}',
        ),
        ("molmo", '<point x="25" y="50">grasp</point> <point x="50" y="25">avoid</point>'),
        (
            "molmo2",
            '<points coords="1 1 250 500">the point to grasp</points>'
            '<points coords="1 1 500 250">avoid this part</points>',
        ),
        ("robopoint", "avoid: [(0.5, 0.25)]\ngrasp: [(0.25, 0.5)]"),
        (
            "internvl",
            "<ref>avoid</ref><box>[[490, 240, 510, 260]]</box>"
            "<ref>grasp</ref><box>[[250, 500]]</box>",
        ),
    ],
)
def test_two_points_are_told_apart_by_what_they_are_labelled(profile, said):
    assert _read(said, TWO, profile) == {"grasp": GRASP, "avoid": AVOID}


@pytest.mark.parametrize(
    ("profile", "said", "status"),
    [
        ("gemini", '[{"point": [500, 250]}, {"point": [250, 500]}]', "ambiguous"),
        (
            "gemini",
            '[{"point": [500, 250], "label": "handle"}, {"point": [250, 500], "label": "blade"}]',
            "ambiguous",
        ),
        (
            "gemini",  # it could be meant either way
            '[{"point": [500, 250], "label": "do not grasp"}, {"point": [9, 9], "label": "avoid"}]',
            "ambiguous",
        ),
        (
            "gemini",
            '[{"point": [500, 250], "label": "grasp"}, {"point": [9, 9], "label": "grasp"},'
            ' {"point": [250, 500], "label": "avoid"}]',
            "ambiguous",
        ),
        ("gemini", '[{"point": [500, 250], "label": "grasp"}]', "unreadable"),
        ("molmo2", '<points coords="1 1 250 500 2 500 250">grasp, avoid</points>', "ambiguous"),
        ("robopoint", "[(0.25, 0.5), (0.5, 0.25)]", "ambiguous"),
    ],
)
def test_points_whose_roles_cannot_be_told_are_not_told_by_their_order(profile, said, status):
    assert _read(said, TWO, profile) == status


# Nothing but the typed error, and soon


@dataclass
class Mutation:
    """A piece of text that is put over a part of another."""

    start: float
    length: float
    piece: str

    def __call__(self, text):
        at = int(self.start * len(text))
        return text[:at] + self.piece + text[at + int(self.length * len(text)) :]


ANSWERS = (
    '{"reasoning": "1 is near the head", "choice": "3"}',
    '{"reasoning": "…", "points": [{"point": [500, 250], "label": "grasp"}]}',
    '```json\n[{"point_2d": [250, 500], "label": "grasp"}, {"x": 1, "y": 2}]\n```',
    '<point x="25.0" y="50.0" alt="handle">handle</point>',
    '<points coords="1 1 250 500 2 500 250">grasp</points>',
    "<ref>grasp</ref><box>[[200, 400, 300, 600]]</box>",
    "<|box_start|>(200,400),(300,600)<|box_end|>",
    "grasp: [(0.25, 0.5)]\navoid: [(0.5, 0.25)]",
    "<think>1 or 2?</think>\nFinal answer: 3",
)
PIECES = ("", "NaN", "1e999", "-1", "99999999999999999999", "{", "]", '"', "\\", "\n", "<think>",
          "```", "\x00", "\ud800", "٣", "½", "0x10", "1_0", "lambda: 0", "null", "true", "'", "...",
          "<points ", "(", "not ")  # fmt: skip
MUTATIONS = st.lists(
    st.builds(
        Mutation, st.floats(0, 1), st.floats(0, 0.5), st.sampled_from(PIECES) | st.text(max_size=8)
    ),
    max_size=4,
)
EXPECTED = (NUMBERS, COLORS, ONE, TWO)


def _is_valid(answer, expects):
    if isinstance(expects, Options):
        return answer in expects.labels
    inside = all(0 <= u <= 639 and 0 <= v <= 479 for u, v in answer.values())
    return tuple(answer) == expects.roles and inside


WRITTEN = {profile.formats: profile for profile in PROFILES.values()}.values()  # each way once


def _read_checked(text):
    for profile in WRITTEN:
        for expects in EXPECTED if profile.name == "pixels" else (ONE, TWO):
            try:
                assert _is_valid(read(text, profile, expects), expects)
            except Unanswered as failure:
                assert failure.status in get_args(AnswerStatus) and failure.status != "ok"
                assert len(str(failure)) < 1000 and str(failure).isprintable()


@given(text=st.text() | st.text(alphabet="[]{}(),:\"'\\`<>/ \n.-019xyredpointschoice", max_size=80))
@example("[" + "-" * 3000 + "1]")
@example("[" + "1+" * 1500 + "1]")
@example("{" + "[" * 40 + "]" * 40 + "}")
@example("[lambda: (yield)]")
@example('{"choice": "\\d"}')
def test_any_text_is_read_or_is_unanswered(text):
    _read_checked(text)


@given(text=st.sampled_from(ANSWERS), mutations=MUTATIONS)
def test_any_change_to_an_answer_leaves_an_answer_or_none(text, mutations):
    for mutate in mutations:
        text = mutate(text)
    _read_checked(text)


@pytest.mark.parametrize(
    "piece",
    ["[", "{", "[]", "[[1,1]],", '{"x":1,"y":1}', '{"a":', '"', "\\", ",", " ", "\n", "1 ", "1",
     "a", "(1,1)", "answer: ", "```\n", "<think>", "<point ", '<point x="1" y="1">', 'coords="',
     "<ref>", "<|box_start|>", "x1=1 ", "- ", "not "],
)  # fmt: skip
def test_no_text_of_full_length_makes_a_pattern_backtrack(piece):
    text = piece * (MAX_LENGTH // len(piece))
    asked = [(text, NUMBERS, "pixels"), ("[" + text[2:] + "]", NUMBERS, "pixels")]
    asked += [(text, ONE, name) for name in ("internvl", "qwen2.5-vl", "robobrain-2.0")]
    asked += [(f"<points {text[9:]}>", ONE, name) for name in ("molmo", "molmo2")]
    for said, expects, name in asked:
        assert _read(said, expects, name) != "too_long"  # backtracking would take minutes


def test_ten_megabytes_are_too_long_at_once():
    assert _read("<think>" * 1_500_000) == "too_long"


# How it is asked


@pytest.mark.parametrize("name", PROFILES)
def test_every_family_is_told_the_labels_and_roles_that_count(name):
    profile = PROFILES[name]
    assert instruction(profile, NUMBERS).endswith("1, 2, 3, 4.")
    for role in TWO.roles:
        assert f'"{role}"' in instruction(profile, TWO)
    assert "{" not in instruction(profile, ONE).replace('{"', "")


def test_pixels_are_asked_for_in_the_image_that_the_model_sees():
    assert "640 pixels wide and 480 pixels high" in instruction(PROFILES["gpt"], ONE)
    assert "644 pixels wide and 476 pixels high" in instruction(PROFILES["qwen2.5-vl"], ONE)


@pytest.mark.parametrize("name", PROFILES)
@pytest.mark.parametrize("expects", EXPECTED)
def test_a_schema_asks_for_the_reasoning_first_and_for_all_that_is_read(name, expects):
    profile = PROFILES[name]
    asked = schema(profile, expects)
    if not profile.structured:
        assert asked is None
        return
    assert next(iter(asked["properties"])) == "reasoning"
    assert asked["required"] == list(asked["properties"])
    said = json.dumps(_example(asked))
    assert _is_valid(read(said, profile, expects), expects)


def _example(asked, label=0):
    """A value of a schema: the first label, 0 or 1 for numbers; for a list one item per label."""
    match asked["type"]:
        case "object":
            return {k: _example(v, label) for k, v in asked["properties"].items()}
        case "array" if asked["items"]["type"] == "object":
            labels = asked["items"]["properties"]["label"]["enum"]
            return [_example(asked["items"], n) for n in range(len(labels))]
        case "array":
            return [_example(asked["items"])] * asked["minItems"]
        case "string":
            return asked["enum"][label] if "enum" in asked else "because of 7"
        case _:
            return 1
