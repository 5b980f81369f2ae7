"""People judge grasps blindly; how far they, the geometry and a model agree."""

import json
import re

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from run_folder import make_line, write_run

from tog_drake.benchmark.human_labels import (
    PICTURE,
    agreement,
    agreements,
    export_sample,
    identifier,
    import_answers,
    labels_of,
)
from tog_drake.benchmark.journal import LABELS, read_run
from tog_drake.errors import InputError

LINES = [
    make_line(0, task="use the hammer", method="vlm gsi"),
    make_line(1, task="hand me the <b>hammer</b>", complies=False),
    make_line(2, "empty", task="use the mug", object="mug"),
]


def run(folder, lines=LINES):
    write_run(folder, lines)
    for line in lines:
        place = folder / "episodes" / line["cell"]["name"]
        place.mkdir()
        draw(place / PICTURE)
    return folder


def draw(file, value=90):
    cv2.imwrite(str(file), np.full((40, 60, 3), value, np.uint8))


def answers_of(folder, *said):
    """The file that the page of a run saves when this was said of its lines."""
    file = folder / "answers.jsonl"
    answers = []
    for line, answer in said:
        picture = (folder / "episodes" / line["cell"]["name"] / PICTURE).read_bytes()
        answers.append({"id": identifier(line, picture), "answer": answer})
    file.write_text("".join(json.dumps(answer) + "\n" for answer in answers))
    return file


def about(line):
    return line["cell"]["name"], line["cell"]["task"]


def test_cohens_kappa_is_that_of_a_table_worked_by_hand():
    # 20 both yes, 15 both no, 5 and 10 apart: p0 = 0.70, pe = 0.5·0.6 + 0.5·0.4 = 0.50, κ = 0.40
    # (the example of the Wikipedia article on Cohen's kappa).
    pairs = [(True, True)] * 20 + [(True, False)] * 5 + [(False, True)] * 10
    pairs += [(False, False)] * 15
    found = agreement(pairs)
    assert (found.n, found.agree) == (50, 0.7)
    assert found.kappa == pytest.approx(0.4)


@given(st.lists(st.tuples(st.booleans(), st.booleans()), max_size=40))
def test_kappa_is_at_most_one_and_does_not_depend_on_who_is_first(pairs):
    one, other = agreement(pairs), agreement([(b, a) for a, b in pairs])
    assert one.agree == other.agree
    assert (one.kappa is None) == (other.kappa is None)
    if one.kappa is not None:
        assert one.kappa == pytest.approx(other.kappa)
        assert -1 <= one.kappa <= 1 + 1e-9
        assert (one.kappa == pytest.approx(1.0)) == (one.agree == 1.0)


def test_the_page_shows_the_task_and_the_picture_and_nothing_of_who_chose(tmp_path):
    assert export_sample(run(tmp_path / "run"), tmp_path / "page.html", count=10, seed=0) == 3
    page = (tmp_path / "page.html").read_text()
    assert page.count("data:image/jpeg") == 3
    assert "<b>hammer" not in page
    assert "&lt;b&gt;hammer" in page
    for secret in ("vlm gsi", "oracle", "empty", "lifted", "episode-0"):
        assert secret not in page


def test_the_sample_is_drawn_by_the_seed(tmp_path):
    folder = run(tmp_path / "run", [make_line(i, task=f"task {i}") for i in range(30)])

    def drawn(seed):
        export_sample(folder, tmp_path / "page.html", count=5, seed=seed)
        return re.findall(r'data-id="(\w+)"', (tmp_path / "page.html").read_text())

    assert drawn(0) == drawn(0) != drawn(1)
    assert len(set(drawn(0))) == 5


def test_answers_come_back_and_later_ones_replace_earlier_ones(tmp_path):
    folder = run(tmp_path / "run")
    assert import_answers(folder, answers_of(folder, (LINES[0], "yes"), (LINES[1], "no"))) == 2
    assert import_answers(folder, answers_of(folder, (LINES[1], "unclear"))) == 1
    assert labels_of(read_run(folder)) == {about(LINES[0]): True, about(LINES[1]): None}


def test_what_was_said_of_a_picture_that_has_changed_is_refused_and_no_longer_counts(tmp_path):
    folder = run(tmp_path / "run")
    answers = answers_of(folder, (LINES[0], "yes"), (LINES[1], "no"))
    assert import_answers(folder, answers) == 2
    draw(folder / "episodes" / LINES[0]["cell"]["name"] / PICTURE, 91)
    assert labels_of(read_run(folder)) == {about(LINES[1]): False}
    with pytest.raises(InputError, match=r"its picture has changed since; valid"):
        import_answers(folder, answers)
    assert import_answers(folder, answers_of(folder, (LINES[0], "unclear"))) == 1


@pytest.mark.parametrize(
    "content",
    [
        "yes\n",
        '{"id": "x"}\n',
        '{"id": "x", "answer": "perhaps"}\n',
        "[1, 2]\n",
        '{"id": ["x"], "answer": "yes"}\n',
        '{"id": "unknown", "answer": "yes"}\n',
        "\x00",
    ],
)
def test_a_file_of_something_else_is_refused_and_nothing_is_lost(tmp_path, content):
    folder = run(tmp_path / "run")
    import_answers(folder, answers_of(folder, (LINES[0], "yes")))
    before = (folder / LABELS).read_bytes()
    (folder / "answers.jsonl").write_text(content)
    with pytest.raises(InputError, match="valid"):
        import_answers(folder, folder / "answers.jsonl")
    assert (folder / LABELS).read_bytes() == before


def test_a_run_without_pictures_cannot_be_judged(tmp_path):
    with pytest.raises(InputError, match=PICTURE):
        export_sample(write_run(tmp_path, LINES), tmp_path / "page.html", count=10, seed=0)


def test_who_agrees_with_whom_is_counted_where_both_have_judged(tmp_path):
    said = {"model": "m", "status": "ok", "cost": None, "seconds": 1.0}
    lines = [
        make_line(0, judge={**said, "complies": True}),
        make_line(1, complies=False, judge={**said, "complies": True}),
        make_line(2, complies=False, judge={**said, "complies": False}),
        make_line(3, judge={**said, "complies": None}),
    ]
    labels = {about(lines[0]): True, about(lines[1]): False, about(lines[2]): None}
    found = agreements(lines, labels)
    assert (found["model and geometry"].n, found["model and geometry"].agree) == (3, 2 / 3)
    assert (found["people and geometry"].n, found["people and geometry"].agree) == (2, 1.0)
    assert (found["people and model"].n, found["people and model"].agree) == (2, 0.5)
    assert "people and geometry" not in agreements(lines, {})
