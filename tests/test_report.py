import base64
import gzip
import re
import shutil
import subprocess
import unicodedata
from html.parser import HTMLParser

import numpy as np
import pytest
from pydrake.geometry import Box
from pydrake.math import RigidTransform
from pydrake.trajectories import PiecewisePolynomial

from tog_drake.report import EpisodeReport, _spread, report_html, write_report
from tog_drake.values import Exchange, GraspMotion, Intrinsics, View
from tog_drake.visualization import make_meshcat, replay_html

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "chrome"))), None)


def make_record(**changes):
    return {
        "schema": "tog_drake/episode/1",
        "task": "hand me the hammer",
        "object": "hammer",
        "scenario": "Hammer",
        "seed": 7,
        "selector": {"kind": "geometric"},
        "counts": {"points": 12345, "proposed": 300, "feasible": 90, "candidates": 8},
        "rejected": {"no_ik": 150, "hand_collision": 60, "arm_collision": 0},
        "choice": {
            "index": 4,
            "part": "head",
            "reason": "The wide end.",
            "status": "ok",
            "pixel": [320.4, 201.6],
        },
        "outcome": "lifted",
        "message": None,
        "grasp_success": True,
        "task_compliance": False,
        "combined_success": False,
        "held": {"head": 0.8, "handle": 0.2},
        "allowed": ["head"],
        "lift": 0.123,
        "seconds": {"render": 0.02, "propose": 0.5, "plan": None, "decide": 0.52, "execute": 2.5},
        "sim": {"seconds": 7.5, "real_time_rate": 3.0},
        **changes,
    }


def make_view(size=(480, 640)):
    random = np.random.default_rng(0)
    return View(
        rgb=random.integers(0, 256, (*size, 3), dtype=np.uint8),  # noise: the largest PNG
        depth=random.uniform(0.4, 0.8, size).astype(np.float32),
        intrinsics=Intrinsics(size[1], size[0], 600.0, 600.0, 319.5, 239.5),
        X_WC=np.eye(4),
    )


def make_motion():
    arm = PiecewisePolynomial.FirstOrderHold([0.0, 2.0], np.array([[0.0] * 7, [1.0] * 7]).T)
    hand = PiecewisePolynomial.FirstOrderHold([0.0, 2.0], np.array([[0.08, 0.0]]))
    return GraspMotion(arm, hand, 2.0, {"approach": 0.5, "close": 1.5}, "straight")


def make_replay():
    """A real replay: a box that moves."""
    meshcat = make_meshcat()
    meshcat.SetObject("/box", Box(0.1, 0.1, 0.1))
    meshcat.StartRecording(frames_per_second=10.0)
    for t in (0.0, 1.0):
        meshcat.SetTransform("/box", RigidTransform([t, 0, 0]), t)
    return replay_html(meshcat, duration=1.0)


def text_of(page):
    """The text that a reader sees, with spaces made one."""

    class Text(HTMLParser):
        def __init__(self):
            super().__init__()
            self.parts, self.tags, self.attributes = [], [], []

        def handle_starttag(self, tag, attrs):
            self.tags.append(tag)
            self.attributes += [(tag, *a) for a in attrs]

        def handle_data(self, data):
            self.parts.append(data)

    parser = Text()
    parser.feed(page)
    parser.text = " ".join(" ".join(parser.parts).split())
    return parser


def test_the_page_tells_what_happened():
    page = text_of(report_html([EpisodeReport(make_record(), make_view(), motion=make_motion())]))
    for said in (
        "“hand me the hammer”",
        "hammer · scenario Hammer · seed 7 · geometric selector",
        "✓ lifted",
        "✗ task not obeyed",
        "held: head 80%, handle 20%",
        "The wide end.",
        "pixel (320, 202)",
        "12,345 points of the cloud",
        "300 grasps proposed",
        "90 feasible",
        "8 candidates shown",
        "no IK 150",
        "hand collision 60",
        "render the image 20",
        "Image to motion 520",
        "7.5 s simulated, 3.0 × real time",
        "2.00 s; straight",
        "transfer approach close",
        "from 0.40 m (bright) to 0.80 m (dark)",
    ):
        assert said in page.text, said
    assert "arm collision" not in page.text.split("episode.json")[0]  # nothing fell to it


def test_an_episode_that_failed_early_still_has_a_page():
    nothing = dict.fromkeys(make_record())
    failed = nothing | {
        "task": "x",
        "outcome": "no_grasp",
        "grasp_success": False,
        "message": "0 of 12 grasps reachable",
        "counts": {"points": 10, "proposed": 12, "feasible": 0, "candidates": None},
        "rejected": {"no_ik": 12},
    }
    page = text_of(report_html([EpisodeReport(failed, make_view())])).text
    assert "✗ no grasp" in page
    assert "no grasp: 0 of 12 grasps reachable" in page
    assert "0 feasible – candidates shown" in page
    assert "No motion was planned." in page
    assert "None" not in page.split("episode.json")[0]
    for record in (nothing, {}):
        assert "No stage was timed." in report_html([EpisodeReport(record)])


def test_of_a_network_it_says_which_weights_it_had():
    weights = {"file": "w.pt", "released": False, "note": "not the <released> ones"}
    record = make_record(proposer={"kind": "contact-graspnet", "weights": weights})
    page = report_html([EpisodeReport(record)])
    assert "contact-graspnet proposer, weights: not the &lt;released&gt; ones" in page
    remote = make_record(proposer={"kind": "remote", "url": "http://gpu:1/x"})
    assert "remote:http://gpu:1/x proposer" in report_html([EpisodeReport(remote)])
    assert "weights:" not in report_html([EpisodeReport(make_record())])


def test_of_a_real_arm_it_says_the_speed_the_rule_and_what_the_hand_felt():
    hardware = {
        "speed": 0.25,
        "rule": "external_torque",
        "opening_closed": 0.0121,
        "opening_after": 0.0119,
        "force": None,
        "late": 0.01,
    }
    page = text_of(report_html([EpisodeReport(make_record(hardware=hardware))])).text
    assert "25% of the planned speed, stopped by the safety rule external torque" in page
    assert "12.1 mm when the lift began, 11.9 mm after it" in page
    assert "Part held" not in page
    unmoved = dict.fromkeys(hardware) | {"speed": 1.0}
    page = text_of(report_html([EpisodeReport(make_record(hardware=unmoved))])).text
    assert "Hand's opening not reached" in page


def test_the_oracle_says_what_it_reads_wherever_it_appears():
    page = report_html([EpisodeReport(make_record(selector={"kind": "oracle"}))])
    assert "oracle selector (reads the simulated part labels: an upper bound)" in page


def test_several_episodes_are_summed_up_first():
    episodes = [EpisodeReport(make_record(task=task)) for task in ("drive a nail", "hand it over")]
    page = text_of(report_html(episodes))
    targets = {a[2][1:] for a in page.attributes if a[:2] == ("a", "href")}
    anchors = {a[2] for a in page.attributes if a[:2] == ("article", "id")}
    assert targets == anchors == {"episode-1", "episode-2"}
    assert not [a for a in text_of(report_html(episodes[:1])).attributes if a[0] == "a"]


def test_everything_that_came_from_outside_is_escaped():
    evil = "</script><script>alert(1)</script><img src=x onerror=alert(2)>\"'{{ 7*7 }}"
    record = make_record(
        task=evil,
        object=evil,
        scenario=evil,
        outcome=evil,
        message=evil,
        allowed=[evil],
        held={evil: 1.0},
        rejected={evil: 3},
        selector={"kind": evil},
        choice={"reason": evil, "part": evil, "status": evil},
    )
    motion = GraspMotion(make_motion().arm, make_motion().hand, 2.0, {evil: 0.5}, evil)
    ours = text_of(
        report_html([EpisodeReport(make_record(), make_view(), motion=make_motion())] * 2)
    )
    page = text_of(report_html([EpisodeReport(record, make_view(), motion=motion)] * 2, title=evil))
    assert page.tags.count("script") == ours.tags.count("script") == 1
    assert page.tags.count("img") == ours.tags.count("img")
    assert not [a for a in page.attributes if a[1].startswith("on")]
    assert "49" not in re.findall(r"(\d+) \}\}", page.text) and "{{ 7*7 }}" in page.text


HOSTILE = {
    "script": "</script><script>alert(1)</script>",
    "pre": "</pre><img src=x onerror=alert(1)><iframe srcdoc='<script>alert(2)</script>'>",
    "template": "{{ 7*7 }}{% raw %}",
    "controls": "\x00\x07\x1b[2J\x9b31m\x7f",
    "overrides": "\u202egnorw\u202c \u2066x\u2069 \u200b",
    "surrogates": "\ud800 and \udfff",
    "long": 100_000 * "so ",
    "entities": "&lt;b&gt; &#x202e;",
}


def make_exchange(answer="2", **changes):
    """A question with two images, and what a model made of it."""
    image = np.random.default_rng(1).integers(0, 256, (224, 224, 3), dtype=np.uint8)
    clean = np.full((224, 224, 3), 200, np.uint8)
    said = {
        "prompt": "gsi/1",
        "text": "Which hand fits?\n[image 1]\n[image 2]",
        "images": (clean, image),
        "marks": {"1": 12, "2": 4},
        "key": "0123abcd",
        "answer": answer,
        "status": "ok",
        "message": "",
        "model": "gpt-9-2026-01-01",
        "seconds": 0.81,
        "tokens": {"input": 1200, "output": 34},
        "cost": 0.00123,
    }
    return Exchange(**(said | changes))


def make_vlm(**changes):
    return {
        "strategy": "gsi",
        "rendering": "marked",
        "model": "openai:gpt-9",
        "seed": 3,
        "status": "ok",
        "fallback": None,
        **changes,
    }


def test_the_page_tells_what_a_model_was_asked_and_what_it_said():
    episode = EpisodeReport(make_record(vlm=make_vlm()), exchanges=(make_exchange(),))
    page = text_of(report_html([episode]))
    for said in (
        "What the model was asked",
        "Strategy gsi",
        "Model asked for openai:gpt-9",
        "Seed of the marks 3",
        "Question 1 gsi/1 ok",
        "Image 1 224×224",
        "Which hand fits?",
        "Answer 2",
        "1 is grasp 12; 2 is grasp 4 (chosen)",
        "Model that answered gpt-9-2026-01-01",
        "0.8 s, 1,234 tokens, $0.0012",
        "1,200 input, 34 output",
        "Key 0123abcd",
    ):
        assert said in page.text, said
    assert page.tags.count("img") == 2
    assert "What the model was asked" not in report_html([EpisodeReport(make_record())])


def test_the_page_tells_what_was_asked_at_every_look_and_sums_it():
    episode = EpisodeReport(
        make_record(vlm=make_vlm()),
        exchanges=(make_exchange(),),
        exchanges_before=(make_exchange("1", prompt="gsi/0"),),
    )
    page = text_of(report_html([episode]))
    for said in (
        "Question 1 gsi/0, at an earlier look, whose grasp failed ok",
        "Question 2 gsi/1 ok",
        "In all 1.6 s, 2,468 tokens, $0.0025",
    ):
        assert said in page.text, said
    assert page.text.count("2 is grasp 4 (chosen)") == 1  # a row of the last look


def test_the_page_tells_of_an_answer_that_was_no_use_and_who_chose_instead():
    nothing = make_exchange(
        None, status="timed_out", message="no answer in 60 s", model=None, tokens=None, cost=None
    )
    record = make_record(vlm=make_vlm(status="timed_out", fallback="geometric"))
    page = text_of(report_html([EpisodeReport(record, exchanges=(make_exchange("7"), nothing))]))
    for said in (
        "Fallback geometric, which made the choice",
        "Question 2 gsi/1 timed out",
        "Answer None came. What is wrong no answer in 60 s",
        "Model that answered not said",
        "0.8 s, price unknown",
        "1.6 s, price unknown",  # in all
        "chosen by geometric, not by the model",
    ):
        assert said in page.text, said


def test_the_page_tells_replayed_answers_from_live_ones():
    exchanges = make_exchange(replayed="a<b>.jsonl"), make_exchange("1")
    page = text_of(report_html([EpisodeReport(make_record(vlm=make_vlm()), exchanges=exchanges)]))
    replayed = "It took replayed from a<b>.jsonl; when asked 0.8 s, 1,234 tokens, $0.0012"
    assert page.text.count(replayed) == 1
    assert "It took 0.8 s, 1,234 tokens" in page.text
    assert "In all 1 of 2 replayed from a<b>.jsonl; when asked 1.6 s" in page.text
    assert "chosen by" not in page.text


def test_an_image_that_is_asked_about_again_is_carried_once():
    asked = make_exchange("?", status="unreadable"), make_exchange()
    page = text_of(report_html([EpisodeReport(make_record(vlm=make_vlm()), exchanges=asked)]))
    assert page.tags.count("img") == 2
    assert "Image 2 224×224, the same as image 2 of question 1" in page.text


def test_where_an_answer_points_is_ringed_in_the_image_it_was_asked_of():
    missed = make_exchange(
        points={"grasp": (111.5, 55.5), "avoid": (500.0, -3.0)}, status="off_object", message="far"
    )
    page = text_of(report_html([EpisodeReport(make_record(vlm=make_vlm()), exchanges=(missed,))]))
    rings = [a[2] for a in page.attributes if a[:2] == ("span", "style") and "left" in a[2]]
    assert rings == ["left: 50.00%; top: 25.00%", "left: 100.00%; top: 0.00%"]
    assert (
        "Image 2 224×224, ringed: where the model points to grasp and to avoid (dashed)"
        in page.text
    )
    assert "Image 1 224×224 " in page.text


@pytest.mark.parametrize("kind", HOSTILE)
def test_whatever_a_model_says_is_inert_and_short(kind):
    said = HOSTILE[kind]
    everything = make_exchange(
        said, prompt=said, text=said, message=said, model=said, key=said, marks={said: 1}
    )
    record = make_record(
        choice={"reason": said, "part": said, "status": "ok"},
        vlm=make_vlm(strategy=said, model=said, status=said, exchanges=[{"answer": said}]),
    )
    html = report_html([EpisodeReport(record, exchanges=(everything,))])
    ours = report_html([EpisodeReport(make_record(vlm=make_vlm()), exchanges=(make_exchange(),))])
    page, plain = text_of(html), text_of(ours)
    html.encode()
    for tag in ("script", "img", "iframe", "pre", "meta"):
        assert page.tags.count(tag) == plain.tags.count(tag), tag
    assert not [a for a in page.attributes if a[1].startswith("on") or a[1] == "srcdoc"]
    assert "script-src 'unsafe-inline'" in html  # the policy stands
    hidden = {c for c in page.text if unicodedata.category(c) in ("Cc", "Cf", "Cs")}
    assert hidden == set()
    assert len(html) < len(ours) + 60_000


def test_the_page_asks_nobody_for_anything():
    page = text_of(
        report_html(
            [EpisodeReport(make_record(), make_view(), make_view().rgb, make_motion(), "<p>hi</p>")]
        )
    )
    sources = [a[2] for a in page.attributes if a[1] in ("src", "href", "srcset", "data", "action")]
    assert sources and all(source.startswith(("data:image/png;base64,", "#")) for source in sources)
    assert "link" not in page.tags and "http" not in page.text and "@import" not in page.text
    assert ("img", "alt", "") not in page.attributes
    assert sum(a[:2] == ("img", "alt") for a in page.attributes) == page.tags.count("img") == 3
    assert "default-src data: blob:" in " ".join(str(a[2]) for a in page.attributes)


def test_a_replay_is_carried_whole():
    page = report_html([EpisodeReport(make_record(), replay="<p>replay ⚒</p>")])
    (packed,) = re.findall(r'<script type="application/gzip" id="replay-1">([^<]*)</script>', page)
    assert gzip.decompress(base64.b64decode(packed)).decode() == "<p>replay ⚒</p>"


def test_two_episodes_with_replays_of_five_megabytes_fit_into_fifteen(tmp_path):
    view = make_view()
    noise = base64.b64encode(np.random.default_rng(0).bytes(2_000_000)).decode()  # the rest of 5 MB
    episode = EpisodeReport(
        make_record(), view, view.rgb, make_motion(), make_replay() + f"<!-- {noise} -->"
    )
    write_report(tmp_path / "report.html", [episode, episode])
    assert (tmp_path / "report.html").stat().st_size < 15e6


def test_labels_of_the_plot_keep_apart_and_in_order():
    placed = _spread([50.0, 10.0, 12.0, 11.0])
    assert placed == [50.0, 10.0, 34.0, 22.0]


@pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium: apt-get install chromium")
def test_a_browser_shows_the_page_and_the_replay_without_complaint(tmp_path):
    path = tmp_path / "report.html"
    view = make_view((48, 64))
    task = "<script>document.title = 'broken into'</script>"
    write_report(
        path,
        [EpisodeReport(make_record(task=task), view, view.rgb, make_motion(), make_replay())],
        title="A report",
    )
    press = "<script>document.querySelector('button').click()</script></body>"
    path.write_text(path.read_text().replace("</body>", press))
    ran = subprocess.run(
        [
            CHROMIUM,
            "--headless=new",
            "--no-sandbox",
            "--enable-unsafe-swiftshader",
            "--enable-logging=stderr",
            f"--user-data-dir={tmp_path / 'profile'}",
            "--virtual-time-budget=3000",
            "--dump-dom",
            path.as_uri(),
        ],
        capture_output=True,
        text=True,
        timeout=120,
        check=True,
    )
    complaints = [line for line in ran.stderr.splitlines() if "CONSOLE" in line]
    assert not [line for line in complaints if "GL Driver Message" not in line]
    dom = text_of(ran.stdout)
    assert "<title>A report</title>" in ran.stdout
    (page,) = (a[2] for a in dom.attributes if a[:2] == ("iframe", "srcdoc"))
    assert "Drake MeshCat" in page and "set_animation" in str(
        [base64.b64decode(m) for m in re.findall(r"octet-binary;base64,([^\"]*)\"", page)]
    )
