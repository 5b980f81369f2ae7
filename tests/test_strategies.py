"""The strategies, asked by hand: a test plays the model."""

import re
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tabletop import HAMMER_SIZED, TABLE, look

from tog_drake.drawing import CANDIDATE_COLORS
from tog_drake.errors import InputError, NoChoice, Unanswered
from tog_drake.pinhole import project, unproject
from tog_drake.selectors.pointed import KEEP_OFF, MAX_MISS, MAX_REACH
from tog_drake.selectors.scene import Scene
from tog_drake.selectors.strategies import CROWDED, PERMUTABLE, PIVOT_MARKS, ROUNDS, STRATEGIES
from tog_drake.selectors.vlm.question import Options, Points
from tog_drake.values import Candidates, Grasps

HEIGHT = 0.03  # [m] of the top of the bar


@cache
def seen():
    """What a camera sees of a bar along x, and the points of the bar that it sees."""
    view = look([TABLE, HAMMER_SIZED])
    points = unproject(view).reshape(-1, 3)
    return view, points[np.isfinite(points).all(axis=1) & (points[:, 2] > 0.004)]


def bar_scene(rendering="paper", n=9, k=4, **changes):
    """The bar with n grasps from above across it in a row; k of them are candidates."""
    view, points = seen()
    x = np.linspace(0.41, 0.59, n)
    X_WG = np.tile(np.diag([1.0, -1.0, -1.0, 1.0]), (n, 1, 1))
    X_WG[:, :3, 3] = np.column_stack([x, np.zeros(n), np.full(n, 0.02)])
    contacts = np.column_stack([x, np.full(n, -0.015), np.full(n, 0.02)])
    grasps = Grasps(X_WG, np.full(n, 0.03), np.linspace(0.9, 0.5, n), contacts)
    index = np.linspace(0, n - 1, k).round().astype(int)
    cluster = np.abs(np.arange(n)[:, None] - index).argmin(axis=1)
    candidates = Candidates(grasps, index, cluster)
    scene = Scene(view, points, candidates, "use the hammer", rendering, seed=3)
    return replace(scene, **changes)


class Model:
    """Answers with a function of the question; keeps the questions."""

    def __init__(self, answer):
        self.answer = answer
        self.questions = []

    def __call__(self, question):
        self.questions.append(question)
        return self.answer(question)


def wants(row):
    """A model that knows which grasp it wants and finds the mark on it."""
    return Model(lambda q: next(label for label, r in q.marks.items() if r == row))


def points_at(scene, **p_W):
    """A model that points at places in W, in the picture that it was sent."""

    def answer(question):
        (image,) = (part for part in question.parts if not isinstance(part, str))
        assert question.expects.size == (image.shape[1], image.shape[0])
        return {role: to_picture(scene, image, p_W[role]) for role in question.expects.roles}

    return Model(answer)


def to_picture(scene, image, p_W):
    from tog_drake.selectors.marks import frame_things, whole_image

    if scene.rendering == "paper":
        framing = whole_image(scene.view)
    else:
        framing = frame_things(scene.view, scene.points, Grasps.empty())
    pixel = project(np.array([p_W]), scene.view.intrinsics, scene.view.X_WC)[0]
    return tuple(framing.from_view(pixel))


def images_of(question):
    return [part for part in question.parts if not isinstance(part, str)]


@pytest.mark.parametrize("name", PERMUTABLE)
def test_the_grasp_whose_mark_the_model_names_is_picked_whichever_it_is(name):
    scene = bar_scene()
    for row in scene.candidates.index:
        assert STRATEGIES[name](scene, wants(row)).index == row


@pytest.mark.parametrize("name", PERMUTABLE)
def test_the_question_names_its_prompt_and_tells_which_mark_is_which_grasp(name):
    scene = bar_scene("marked")
    model = wants(0)
    STRATEGIES[name](scene, model)
    (question,) = model.questions
    assert question.prompt.startswith(f"{name}/")
    assert isinstance(question.expects, Options)
    assert tuple(question.marks) == question.expects.labels
    assert sorted(question.marks.values()) == sorted(scene.candidates.index)
    assert '"use the hammer"' in question.parts[-1]


@pytest.mark.parametrize(
    ("name", "rendering", "pictures"),
    [
        ("gsi", "marked", 2),
        ("cpsi", "marked", 2),
        ("gmi", "marked", 5),
        ("cpmi", "marked", 5),
        ("gsi", "paper", 1),
        ("cpsi", "paper", 1),
        ("gmi", "paper", 4),
        ("cpmi", "paper", 4),
    ],
)
def test_one_picture_for_all_or_one_for_each_and_marked_shows_the_scene_unmarked_first(
    name, rendering, pictures
):
    scene = bar_scene(rendering)
    model = wants(0)
    STRATEGIES[name](scene, model)
    images = images_of(model.questions[0])
    assert len(images) == pictures
    assert len({image.tobytes() for image in images}) == pictures
    if rendering == "marked":
        vivid = [rgb for _, rgb in CANDIDATE_COLORS[:-1]]
        assert not any((images[0] == rgb).all(axis=2).any() for rgb in vivid)


def test_paper_asks_for_colours_in_one_picture_and_for_numbers_of_several():
    by_color, by_number = wants(0), wants(0)
    scene = bar_scene("paper")
    STRATEGIES["cpsi"](scene, by_color)
    STRATEGIES["gmi"](scene, by_number)
    names = {name for name, _ in CANDIDATE_COLORS[:4]}
    assert set(by_color.questions[0].expects.labels) == names
    assert by_number.questions[0].expects.labels == ("1", "2", "3", "4")
    parts = [part for part in by_number.questions[0].parts if isinstance(part, str)]
    assert parts[:4] == ["Image 1:", "Image 2:", "Image 3:", "Image 4:"]


def marks_of(seed, permutation=0, k=4):
    model = wants(0)
    STRATEGIES["gsi"](bar_scene(k=k, seed=seed, permutation=permutation), model)
    return model.questions[0]


def test_order_and_colours_are_shuffled_by_the_seed_and_by_it_alone():
    assert marks_of(1).marks == marks_of(1).marks
    np.testing.assert_array_equal(images_of(marks_of(1))[0], images_of(marks_of(1))[0])
    assert len({tuple(marks_of(seed).marks.values()) for seed in range(8)}) > 4


@pytest.mark.parametrize("k", [2, 3, 4, 5])
def test_in_the_other_permutation_every_grasp_has_another_mark(k):
    first, second = marks_of(5, 0, k).marks, marks_of(5, 1, k).marks
    assert sorted(first.values()) == sorted(second.values())
    assert all(first[label] != second[label] for label in first)


@pytest.mark.parametrize("name", CROWDED)
def test_more_candidates_than_colours_in_one_picture_are_refused_with_what_to_do(name):
    with pytest.raises(InputError, match=r"13 candidates .* candidates\.k \(--k\) to at most 12"):
        STRATEGIES[name](bar_scene(n=13, k=13), wants(0))


@pytest.mark.parametrize("name", ["gmi", "cpmi"])
def test_where_each_has_a_picture_there_may_be_more_candidates_than_colours(name):
    scene = bar_scene("marked", n=14, k=14)
    model = wants(13)
    assert STRATEGIES[name](scene, model).index == 13
    assert len(images_of(model.questions[0])) == 15
    assert len(set(model.questions[0].marks.values())) == 14


@pytest.mark.parametrize("rendering", ["marked", "paper"])
@settings(max_examples=20)
@given(x=st.floats(0.405, 0.595))
def test_of_all_feasible_grasps_the_one_nearest_to_the_seen_point_wins(rendering, x):
    scene = bar_scene(rendering, n=19, k=3)
    pick = STRATEGIES["cpg"](scene, points_at(scene, grasp=(x, 0.0, HEIGHT)))
    contacts = scene.candidates.grasps.p_WContact[:, 0]
    off = np.abs(contacts - x)
    assert off[pick.index] <= off.min() + 0.004  # the cloud has a point every few millimetres
    assert np.argmax(pick.worth) == pick.index


def across_and_along(**changes):
    """The bar with a grasp across it at 0.51 and one along it, from 0.54 to 0.46."""
    scene = bar_scene(n=2, **changes)
    across = scene.candidates.grasps
    X_WG, contacts, width = across.X_WG.copy(), across.p_WContact.copy(), across.width.copy()
    X_WG[:, 0, 3], contacts[:, 0] = 0.50, 0.51
    X_WG[1, :3, :2] = [[0.0, 1.0], [1.0, 0.0], [0.0, 0.0]]  # the other's y is x of W
    width[1], contacts[1] = 0.08, (0.54, 0.0, 0.02)
    grasps = replace(across, X_WG=X_WG, p_WContact=contacts, width=width)
    return replace(scene, candidates=replace(scene.candidates, grasps=grasps))


@pytest.mark.parametrize("rendering", ["marked", "paper"])
@pytest.mark.parametrize(
    ("nearest", "picked", "said"),
    [
        ("contact", 1, "2 grasps allowed it is nearest .*: its contact is 1[0-9] mm away"),
        ("both", 0, "2 grasps there .* the farther of its two contacts is [23][0-9] mm away"),
    ],
)
def test_the_nearest_contact_counts_or_the_farther_of_both_and_the_reason_says_which(
    rendering, nearest, picked, said
):
    scene = across_and_along(rendering=rendering, nearest=nearest)
    pick = STRATEGIES["cpg"](scene, points_at(scene, grasp=(0.53, 0.0, HEIGHT)))
    assert pick.index == picked
    assert re.search(said, pick.reason)


@pytest.mark.parametrize("nearest", ["contact", "both"])
def test_a_grasp_whose_other_finger_is_on_the_place_to_avoid_is_dropped(nearest):
    scene = across_and_along(nearest=nearest)  # nothing is near the first contact of either
    model = points_at(scene, grasp=(0.545, 0.0, HEIGHT), avoid=(0.46, 0.0, HEIGHT))
    pick = STRATEGIES["avoid"](scene, model)
    assert pick.index == 0
    assert np.isfinite(pick.worth).tolist() == [True, False]
    assert "1 grasps at the place to avoid" in pick.reason


def test_a_point_of_the_picture_is_asked_for_with_its_size():
    scene = bar_scene("marked")
    model = points_at(scene, grasp=(0.5, 0, HEIGHT))
    STRATEGIES["cpg"](scene, model)
    (question,) = model.questions
    assert isinstance(question.expects, Points)
    assert question.expects.roles == ("grasp",)
    assert question.marks == {}


@pytest.mark.parametrize("name", ["cpg", "avoid"])
@pytest.mark.parametrize("rendering", ["marked", "paper"])
def test_a_point_beside_every_object_is_off_object(name, rendering):
    scene = bar_scene(rendering)
    beside = (0.5, 0.12, 0.0)
    with pytest.raises(Unanswered, match="is on no object") as caught:
        STRATEGIES[name](scene, points_at(scene, grasp=beside, avoid=beside))
    assert caught.value.status == "off_object"


def test_a_miss_of_a_few_pixels_is_none_and_grows_with_the_image():
    scene = bar_scene("paper")
    seen = project(scene.points, scene.view.intrinsics, scene.view.X_WC)
    limit = MAX_MISS * 320 / 640
    u, v = seen[np.argmin(seen[:, 1])]  # the uppermost point of the bar in the picture
    assert STRATEGIES["cpg"](scene, Model(lambda q: {"grasp": (u, v - limit + 1)})).index >= 0
    with pytest.raises(Unanswered) as caught:
        STRATEGIES["cpg"](scene, Model(lambda q: {"grasp": (u, v - limit - 1)}))
    assert caught.value.status == "off_object"


@pytest.mark.parametrize("pixel", [(-3, 100), (100, -3), (323, 100), (100, 243)])
def test_a_point_outside_the_view_is_off_image(pixel):
    with pytest.raises(Unanswered, match="outside the view of 320×240") as caught:
        STRATEGIES["cpg"](bar_scene("paper"), Model(lambda q: {"grasp": pixel}))
    assert caught.value.status == "off_image"


def without_middle(scene):
    """The scene with grasps at the ends of the bar only."""
    x = scene.candidates.grasps.p_WContact[:, 0]
    rows = np.flatnonzero((x < 0.43) | (x > 0.57))
    grasps = scene.candidates.grasps.take(rows)
    return replace(scene, candidates=Candidates(grasps, np.array([0]), np.zeros(len(rows), int)))


def test_where_no_grasp_is_near_it_says_so_but_as_published_the_nearest_wins():
    middle = {"grasp": (0.5, 0.0, HEIGHT)}
    both = without_middle(bar_scene("paper", nearest="both"))
    contact = without_middle(bar_scene("paper", nearest="contact"))
    with pytest.raises(NoChoice, match=r"at most 6 cm") as caught:
        STRATEGIES["cpg"](both, points_at(both, **middle))
    assert caught.value.status == "no_grasp_on_part"
    pick = STRATEGIES["cpg"](contact, points_at(contact, **middle))
    assert abs(contact.candidates.grasps.p_WContact[pick.index, 0] - 0.5) > MAX_REACH


def test_grasps_near_the_place_to_avoid_are_dropped():
    scene = bar_scene("marked", n=37, k=3)
    grasp, avoided = (0.47, 0.0, HEIGHT), (0.5, 0.0, HEIGHT)
    pick = STRATEGIES["avoid"](scene, points_at(scene, grasp=grasp, avoid=avoided))
    contacts = scene.candidates.grasps.p_WContact
    left = np.isfinite(pick.worth)
    away = np.linalg.norm(contacts - avoided, axis=1)
    assert left.any()
    assert (away[left] > KEEP_OFF - 0.003).all()
    assert (contacts[left, 0] < 0.485 + 0.003).all()  # nearer to the place to hold


def test_where_every_grasp_is_to_be_avoided_there_is_none():
    scene = without_middle(bar_scene("paper"))
    here = (0.42, 0.0, HEIGHT)
    with pytest.raises(NoChoice, match="finger nearer to the place to avoid") as caught:
        STRATEGIES["avoid"](scene, points_at(scene, grasp=here, avoid=here))
    assert caught.value.status == "no_grasp_on_part"


def nearest_to(scene, x):
    """A model that names the marked grasp nearest to a place."""
    at = scene.candidates.grasps.p_WContact[:, 0]
    return Model(lambda q: min(q.marks, key=lambda label: abs(at[q.marks[label]] - x)))


@pytest.mark.parametrize("x", [0.43, 0.5, 0.58])
def test_pivot_closes_in_on_what_the_model_looks_for(x):
    scene = bar_scene(n=61, k=3)
    model = nearest_to(scene, x)
    pick = STRATEGIES["pivot"](scene, model)
    at = scene.candidates.grasps.p_WContact[:, 0]
    assert len(model.questions) == ROUNDS
    assert abs(at[pick.index] - x) < 0.012  # of 18 cm, by 3 × 6 marks
    spans = [np.ptp(at[list(q.marks.values())]) for q in model.questions]
    assert spans[0] > 2 * spans[1] > 4 * spans[2]


def test_the_winner_of_a_round_is_marked_again_in_the_next():
    scene = bar_scene(n=61, k=3)
    model = nearest_to(scene, 0.5)
    STRATEGIES["pivot"](scene, model)
    for before, after in zip(model.questions, model.questions[1:], strict=False):
        won = before.marks[model.answer(before)]
        assert won in after.marks.values()
        assert "best in the round before" in after.parts[-1]


def test_the_winner_of_a_round_has_another_mark_in_the_next_for_most_seeds():
    stayed = []
    for seed in range(10):
        scene = bar_scene(n=61, k=3, seed=seed)
        model = nearest_to(scene, 0.5)
        STRATEGIES["pivot"](scene, model)
        for before, after in zip(model.questions, model.questions[1:], strict=False):
            won = before.marks[model.answer(before)]
            stayed.append(after.marks.get(model.answer(before)) == won)
    assert len(stayed) == 20
    assert sum(stayed) <= 8  # of six marks one stays by chance


@pytest.mark.parametrize(("n", "rounds"), [(1, 1), (PIVOT_MARKS, 1), (PIVOT_MARKS + 1, 2), (25, 3)])
def test_pivot_ends_when_it_has_shown_all_that_is_left(n, rounds):
    model = nearest_to(bar_scene(n=n, k=1), 0.5)
    STRATEGIES["pivot"](bar_scene(n=n, k=1), model)
    assert len(model.questions) == rounds
    assert all(len(q.marks) <= PIVOT_MARKS for q in model.questions)


def test_pivot_marks_no_grasp_twice_even_where_two_are_the_same():
    scene = bar_scene(n=8, k=1)
    same = scene.candidates.grasps.take(np.zeros(8, int))
    scene = replace(scene, candidates=replace(scene.candidates, grasps=same))
    model = Model(lambda q: q.expects.labels[0])
    STRATEGIES["pivot"](scene, model)
    assert [len(set(q.marks.values())) for q in model.questions] == [
        len(q.marks) for q in model.questions
    ]


@pytest.mark.parametrize("name", STRATEGIES)
def test_what_goes_wrong_with_an_answer_reaches_the_caller(name):
    def refuse(question):
        raise Unanswered("refused", "I would rather not")

    with pytest.raises(Unanswered, match="rather not"):
        STRATEGIES[name](bar_scene(), refuse)


def with_contacts(scene, moved):
    """The scene with the contacts and hands of some rows elsewhere: {row: (3,) [m]}."""
    grasps = scene.candidates.grasps
    X_WG, contact = grasps.X_WG.copy(), grasps.p_WContact.copy()
    for row, by in moved.items():
        X_WG[row, :3, 3] += by
        contact[row] += by
    grasps = replace(grasps, X_WG=X_WG, p_WContact=contact)
    return replace(scene, candidates=replace(scene.candidates, grasps=grasps))


@pytest.mark.parametrize("name", PERMUTABLE)
def test_a_candidate_outside_the_view_is_not_offered(name):
    scene = bar_scene()
    first, *others = scene.candidates.index
    model = wants(others[0])
    STRATEGIES[name](with_contacts(scene, {first: [0, 2.0, 0]}), model)
    (question,) = model.questions
    assert sorted(question.marks.values()) == others
    assert question.expects.labels == tuple(question.marks)


@pytest.mark.parametrize("name", PERMUTABLE)
def test_where_all_candidates_are_outside_the_view_nothing_is_asked(name):
    scene = bar_scene()
    model = wants(0)
    with pytest.raises(Unanswered, match="outside the view") as error:
        STRATEGIES[name](
            with_contacts(scene, {row: [0, 2.0, 0] for row in scene.candidates.index}), model
        )
    assert error.value.status == "off_image"
    assert model.questions == []


@pytest.mark.parametrize("name", PERMUTABLE)
def test_a_hidden_candidate_is_offered_and_the_model_is_told_what_dashes_mean(name):
    scene = bar_scene()
    model = wants(0)
    STRATEGIES[name](with_contacts(scene, {0: [0, 0, -0.1]}), model)
    assert 0 in model.questions[0].marks.values()
    assert "dashed" in model.questions[0].parts[-1]
