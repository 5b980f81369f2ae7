"""Which view sees most of the target and of the candidates."""

import numpy as np
import pytest
from tabletop import GREY, RED, TABLE, look

from tog_drake.cloud import CloudConfig, scene_cloud
from tog_drake.pinhole import project
from tog_drake.scenario import load_scenario
from tog_drake.values import CameraView, Candidates, Grasps, Workspace
from tog_drake.view_scorers.coverage import CoverageScorer
from tog_drake.visibility import shown_in, visible
from tog_drake.world import build_world
from tog_drake.world import look as look_at

BLOCK = ((0.50, -0.03, 0.0), (0.56, 0.03, 0.08), RED)
WALL = ((0.44, -0.08, 0.0), (0.45, 0.08, 0.14), GREY)  # before the block, as seen from x = 0
FRONT, BACK = (0.2, 0.0, 0.30), (0.86, 0.0, 0.30)


def views(*eyes, boxes=(TABLE, BLOCK), target=(0.53, 0.0, 0.03)):
    return [
        CameraView(f"camera_{i}", look(boxes, eye=eye, target=target)) for i, eye in enumerate(eyes)
    ]


def cloud_of(*seen):
    return scene_cloud([v.view for v in seen], Workspace(), CloudConfig())


def grasp_at(*contacts):
    """Grasps 60 mm wide along y whose first contact is at each of these points."""
    p = np.array(contacts, float).reshape(-1, 3)
    X = np.tile(np.eye(4), (len(p), 1, 1))
    X[:, :3, 3] = p + np.array([0, 0.03, 0])
    grasps = Grasps(X, np.full(len(p), 0.06), np.ones(len(p)), p)
    return Candidates(grasps, np.arange(len(p)), np.zeros(len(p), np.int64))


def score(seen, cloud, candidates=None, target="block"):
    scorer = CoverageScorer(Workspace())
    return scorer.score(seen, cloud, candidates or grasp_at(), target, f"take the {target}")


def test_a_view_that_something_stands_before_scores_less():
    seen = views(FRONT, BACK, boxes=[TABLE, BLOCK, WALL])
    cloud = cloud_of(seen[1])
    hidden, open_ = score(seen, cloud, target="red block").values
    assert hidden < 0.7 * open_


def test_a_view_that_cuts_the_target_off_scores_less():
    whole, cut = (
        views(BACK, target=target)[0] for target in ((0.53, 0.0, 0.03), (0.53, 0.36, 0.0))
    )
    u = project(np.array([BLOCK[0], BLOCK[1]]), cut.view.intrinsics, cut.view.X_WC)[:, 0]
    assert (u < 0).any() or (u > cut.view.intrinsics.width).any()
    a, b = score([whole, cut], cloud_of(whole)).values
    assert b < a


def test_a_view_from_nearer_scores_more():
    far, near = views((0.2, 0, 0.6), (0.35, 0, 0.36))
    a, b = score([far, near], cloud_of(far)).values
    assert a < b


def test_a_view_that_sees_nothing_of_the_target_scores_nothing():
    seen = views(FRONT)
    away = CameraView("away", look([TABLE, BLOCK], eye=FRONT, target=(0.2, 0.6, 0.0)))
    assert score([*seen, away], cloud_of(*seen)).values[1] == 0


def test_of_two_mirrored_views_the_one_that_shows_the_candidates_scores_more():
    seen = views((0.3, -0.3, 0.2), (0.3, 0.3, 0.2), target=(0.53, 0.0, 0.04))
    same = score(seen, cloud_of(*seen)).values
    assert same[0] == pytest.approx(same[1], rel=0.05)
    candidates = grasp_at((0.53, -0.03, 0.06))
    narrow = Grasps(
        candidates.grasps.X_WG,
        np.full(1, 1e-3),  # both contacts on the side that the first camera sees
        candidates.grasps.score,
        candidates.grasps.p_WContact,
    )
    candidates = Candidates(narrow, candidates.index, candidates.cluster)
    a, b = score(seen, cloud_of(*seen), candidates).values
    assert a == pytest.approx(same[0])
    assert b == pytest.approx(same[1] * np.cbrt(1 / 2))


def test_what_another_camera_sees_of_the_target_counts_against_one_that_does_not():
    """A handle behind a block: the cloud of the first camera does not have it."""
    handle = ((0.56, -0.01, 0.02), (0.60, 0.01, 0.06), RED)
    seen = views(FRONT, (0.75, 0.25, 0.30), boxes=[TABLE, BLOCK, handle])
    alone, together = score(seen[:1], cloud_of(seen[0])), score(seen, cloud_of(seen[0]))
    assert "sees 100% of it" in alone.reason
    assert together.values[0] < together.values[1]


def test_of_other_things_nothing_counts():
    other = ((0.50, 0.15, 0.0), (0.58, 0.25, 0.06), (0, 0, 200))
    seen = views(FRONT, (0.75, 0.2, 0.35), boxes=[TABLE, BLOCK, other])
    there = score(seen, cloud_of(*seen), target="red block").reason
    seen = views(FRONT, (0.75, 0.2, 0.35))
    without = score(seen, cloud_of(*seen), target="red block").reason
    shares = [reason.split("sees ")[1].split("%")[0] for reason in (there, without)]
    assert float(shares[0]) == pytest.approx(float(shares[1]), abs=3)


def test_a_contact_is_visible_in_front_of_what_is_seen_and_inside_the_image_alone():
    (seen,) = views(FRONT)
    top, back, aside = (0.53, 0.0, 0.08), (0.56, 0.0, 0.02), (0.53, 0.9, 0.0)
    assert visible(np.array([top, back, aside]), seen.view).tolist() == [True, False, False]
    assert visible(np.zeros((0, 3)), seen.view).tolist() == []


def test_a_grasp_is_shown_where_one_of_its_contacts_is_seen():
    seen = views((0.53, -0.4, 0.08))[0].view
    across = grasp_at((0.53, 0.03, 0.04), (0.53, -0.03, 0.04)).grasps
    assert not visible(across.p_WContact[:1], seen).any()  # on the far side
    turned = Grasps(across.X_WG - [[0, 0, 0, 0], [0, 0, 0, 0.06], [0, 0, 0, 0], [0, 0, 0, 0]],
                    across.width, across.score, across.p_WContact)  # fmt: skip
    assert shown_in(turned.take(np.array([0])), seen).tolist() == [True]


@pytest.mark.parametrize(
    ("scenario", "task", "seen"),
    [
        ("BottleFromAbove", "hand me the bottle", 0.35),
        ("MugHandleHidden", "drink from the mug", 0.53),
    ],
)
def test_where_the_wrist_camera_sees_little_a_side_camera_is_shown(scenario, task, seen):
    text = "pipeline: {view_selection: {scorer: !Coverage {}}}"
    loaded = load_scenario(scenario, text)
    world = build_world(loaded)
    simulator = look_at(world, loaded, task)
    mine = world.pipeline.GetMyContextFromRoot(simulator.get_context())
    selected = world.pipeline.GetOutputPort("selected_view").Eval(mine)
    assert list(selected.scores) == ["wrist", "side_1", "side_2", "side_3", "side_4"]
    assert selected.camera != "wrist"
    assert selected.scores[selected.camera] > 1.1 * selected.scores["wrist"]
    share = float(selected.reason.split("wrist sees ")[1].split("%")[0]) / 100
    assert share < seen
    choice = world.pipeline.GetOutputPort("choice").Eval(mine)
    u, v = project(choice.grasp.p_WContact, selected.view.intrinsics, selected.view.X_WC)[0]
    assert choice.pixel == pytest.approx((u, v))  # a pixel of the view that is shown
