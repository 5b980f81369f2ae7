"""What boxes make of views, and the protocol and the client of a detection server."""

import base64
import contextlib
import io
import json
import textwrap
from functools import cache
from http.server import BaseHTTPRequestHandler, HTTPServer

import numpy as np
import pytest
import vlm_server as mishaps
from loopback import LoopbackServer
from PIL import Image
from pydrake.perception import PointCloud
from tabletop import HAMMER_SIZED, TABLE, look

from tog_drake import http_post
from tog_drake.errors import InputError, NoView
from tog_drake.pipeline import make_view_scorer
from tog_drake.scenario import Scenario, parse_scenario
from tog_drake.values import CameraView, Candidates
from tog_drake.view_scorers import detect_protocol
from tog_drake.view_scorers.detect_protocol import (
    MAX_BOXES,
    MAX_LABEL,
    SCHEMA,
    BadAnswer,
    read_answer,
    request_body,
)
from tog_drake.view_scorers.detections import Detection, check_target, score_detections
from tog_drake.view_scorers.remote import Remote, RemoteScorer
from tog_drake.view_selection import select_view

ON_IT = (10.0, 20.0, 40.0, 60.0)


@pytest.fixture(autouse=True)
def no_waiting(monkeypatch):
    monkeypatch.setattr(http_post, "FIRST_DELAY", 0.001)


@cache
def views():
    """Two views of 40 × 30 pixels from opposite sides, and one that looks away."""
    scene = [TABLE, HAMMER_SIZED]
    return tuple(
        CameraView(name, look(scene, eye=eye, target=target, width=40, height=30))
        for name, eye, target in (
            ("wrist", (0.25, 0.0, 0.45), (0.5, 0.0, 0.0)),
            ("side", (0.75, 0.0, 0.45), (0.5, 0.0, 0.0)),
            ("away", (0.5, 0.0, 0.45), (0.5, 3.0, 0.45)),
        )
    )


def found(score, label="mug", box=ON_IT):
    return Detection(label, box, score)


# --- scoring ------------------------------------------------------------------------------------


def test_a_view_is_worth_its_surest_box_of_the_target_and_0_without_one():
    seen = [[found(0.4), found(0.7)], [found(0.3), found(0.99, "spoon")], []]
    scores = score_detections(views(), seen, "mug", "the detector")
    assert scores.values == (0.7, 0.3, 0.0)
    assert scores.reason == "the detector is surest of 'mug' in wrist, at (10, 20) to (40, 60)."


def test_letters_of_a_label_may_be_large_or_small():
    assert score_detections(views()[:1], [[found(0.4, "Mug")]], "mug", "it").values == (0.4,)


@pytest.mark.parametrize("box", [(41, 0, 60, 20), (0, 31, 20, 40), (-9, 0, -1, 20), (0, -9, 9, -1)])
def test_what_lies_wholly_beside_the_image_does_not_count(box):
    seen = [[found(0.9, box=box), found(0.2)]]
    assert score_detections(views()[:1], seen, "mug", "it").values == (0.2,)


def test_where_no_view_shows_the_target_the_reason_says_so():
    scores = score_detections(views(), [[], [], []], "mug", "the detector")
    assert scores.values == (0.0, 0.0, 0.0)
    assert scores.reason == "the detector finds 'mug' in none of 3 views."


def test_without_words_a_detector_cannot_be_asked():
    check_target("mug")
    with pytest.raises(NoView, match="--target WORDS"):
        check_target(" ")


# --- the protocol -------------------------------------------------------------------------------


def good(**changes):
    answer = {"schema": SCHEMA, "boxes": [list(ON_IT)], "labels": ["mug"], "scores": [0.5]}
    return {**answer, **changes}


def test_the_pixels_of_a_view_arrive_as_they_were():
    rgb = np.random.default_rng(0).integers(0, 255, (30, 40, 3), dtype=np.uint8)
    body = json.loads(json.dumps(request_body(rgb, ["red mug"])))
    image = Image.open(io.BytesIO(base64.b64decode(body["image"])))
    np.testing.assert_array_equal(np.asarray(image), rgb)
    assert (body["schema"], body["labels"]) == (SCHEMA, ["red mug"])


def test_an_answer_is_read_box_by_box():
    two = good(boxes=[[0, 0, 5, 5], [1, 2, 3, 4]], labels=["a", "b"], scores=[1, 0.25])
    assert read_answer(two) == [
        Detection("a", (0.0, 0.0, 5.0, 5.0), 1.0),
        Detection("b", (1.0, 2.0, 3.0, 4.0), 0.25),
    ]
    assert read_answer(good(boxes=[], labels=[], scores=[])) == []


@pytest.mark.parametrize(
    ("answer", "said"),
    [
        (None, "schema is none"),
        ([], "schema is none"),
        (good(schema="tog_drake/propose/1"), "schema is .*propose/1"),
        (good(schema="\x1b[2J"), r"schema is \"\\u001b"),
        (good(boxes=None), "boxes is missing or no list"),
        (good(scores={}), "scores is missing or no list"),
        (good(scores=[]), "1 boxes, 1 labels and 0 scores"),
        (good(boxes=[[0, 0, 1, 1]] * (MAX_BOXES + 1)), f"{MAX_BOXES + 1} boxes"),
        (good(boxes=[[0, 0, 1]]), r"boxes\[0\] is no box"),
        (good(boxes=[[5, 0, 1, 1]]), r"boxes\[0\] is no box"),
        (good(boxes=[[0, 0, 1, "1"]]), r"boxes\[0\] is no box"),
        (good(boxes=[[0, 0, 1, True]]), r"boxes\[0\] is no box"),
        (good(boxes=[[0, 0, 1, float("nan")]]), r"boxes\[0\] is no box"),
        (good(boxes=[[0, 0, 1, 10**400]]), r"boxes\[0\] is no box"),
        (good(boxes=[[0, 0, 1, 1e7]]), r"boxes\[0\] is no box"),
        (good(boxes=["0011"]), r"boxes\[0\] is no box"),
        (good(labels=[3]), r"labels\[0\] is no text"),
        (good(labels=["m" * (MAX_LABEL + 1)]), r"labels\[0\] is no text"),
        (good(scores=[1.1]), r"scores\[0\] is no number from 0 to 1"),
        (good(scores=[-0.1]), r"scores\[0\]"),
        (good(scores=[True]), r"scores\[0\]"),
        (good(scores=["0.5"]), r"scores\[0\]"),
    ],
    ids=str,
)
def test_what_is_no_answer_is_refused_with_what_would_be_valid(answer, said):
    with pytest.raises(BadAnswer, match=said):
        read_answer(answer)


# --- the client ---------------------------------------------------------------------------------


class DetectionServer(LoopbackServer):
    """Finds the target as surely as the image is red; a mishap of ``vlm_server`` comes first."""

    def __init__(self, mishap=None):
        super().__init__(_Handler)
        self.mishap = mishap
        self.asked = []


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    send_head = mishaps._Handler.send_head
    send = mishaps._Handler.send

    def log_message(self, *arguments):
        pass

    def do_GET(self):
        pytest.fail("a redirect was followed")

    def do_POST(self):
        owner = self.server.owner
        self.close_connection = True
        body = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
        owner.asked.append((dict(self.headers), body))
        image = np.asarray(Image.open(io.BytesIO(base64.b64decode(body["image"]))))
        self.score = float((image[..., 0].astype(int) - image[..., 1] > 50).mean())
        with contextlib.suppress(OSError):
            if owner.mishap is None:
                self.send(200, self.good())
            else:
                owner.mishap(self, None)

    def good(self, spoken=None):
        boxes = {"boxes": [[0, 0, 40, 30]], "labels": ["hammer"], "scores": [self.score]}
        return json.dumps(good(**boxes)).encode()


def ask(server, target="hammer", **settings):
    scorer = RemoteScorer(Remote(f"{server.url}/detect", **{"timeout": 20.0, **settings}))
    return scorer.score(views(), PointCloud(0), Candidates.empty(), target, "use the hammer")


def test_a_server_is_sent_each_view_and_the_words_and_nothing_else(monkeypatch):
    monkeypatch.setenv("VLM_API_KEY", "planted-key-0123456789")
    with DetectionServer() as server:
        scores = ask(server)
    shares = [float((v.view.rgb[..., 0] > 150).mean()) for v in views()]
    np.testing.assert_allclose(scores.values, shares)
    assert scores.values[0] > 0 and scores.values[1] > 0 and scores.values[2] == 0
    assert len(server.asked) == 3
    for headers, body in server.asked:
        assert set(body) == {"schema", "image", "labels"}
        assert body["labels"] == ["hammer"]
        assert "planted" not in json.dumps(headers)
    assert server.url.split("//")[1] in scores.reason


def test_boxes_of_other_things_than_the_target_are_none_of_it():
    with DetectionServer() as server:
        assert ask(server, target="mug").values == (0.0, 0.0, 0.0)


def test_the_server_in_the_protocols_description_works():
    program = textwrap.dedent(detect_protocol.__doc__.split("whole::")[1].split("What is wrong")[0])
    *_, last = program.strip().splitlines()
    assert last == 'HTTPServer(("127.0.0.1", 8002), Handler).serve_forever()'

    def my_detector(image, labels):
        return [[0, 0, *image.size]], labels, [image.size[0] / 100]

    namespace = {"my_detector": my_detector}
    exec(program.replace(last, ""), namespace)
    assert namespace["HTTPServer"] is HTTPServer
    with LoopbackServer(namespace["Handler"]) as server:
        assert ask(server).values == (0.4, 0.4, 0.4)


@pytest.mark.parametrize(
    ("mishap", "status", "said"),
    [
        (mishaps.hang, "timed_out", "allow more than 0.5 s"),
        (mishaps.trickle, "timed_out", "allow more than 0.5 s"),
        (mishaps.reset, "unreachable", "is it running"),
        (mishaps.cut, "unreachable", "cut in the answer"),
        (mishaps.html(), "unreachable", "something else than JSON"),
        (mishaps.redirect("http://elsewhere/"), "rejected", "redirects"),
        (mishaps.status(500, body=b"{}"), "unreachable", "status 500"),
        (mishaps.status(404, body=b"{}"), "rejected", "status 404"),
        (mishaps.verbatim(b" " * 5 * 2**20), "too_long", "longer than"),
        (mishaps.verbatim(b'{"scores": [0.5]}'), "unreadable", "not with boxes: its schema"),
        (mishaps.verbatim(json.dumps(good(scores=[2])).encode()), "unreadable", "scores"),
    ],
    ids=lambda value: getattr(value, "__name__", ""),
)
def test_a_server_that_misbehaves_ends_in_no_view_which_says_of_what(mishap, status, said):
    with DetectionServer(mishap) as server, pytest.raises(NoView, match=said) as caught:
        ask(server, timeout=0.5 if status == "timed_out" else 20.0)
    assert (caught.value.status, caught.value.outcome) == (status, "no_view")
    assert "the view of wrist" in str(caught.value)


def test_where_there_is_no_server_it_says_so():
    with DetectionServer() as server:
        pass
    with pytest.raises(NoView, match="is it running") as caught:
        ask(server)
    assert caught.value.status == "unreachable"


@pytest.mark.parametrize(
    "url", ["detect", "ftp://gpu/x", "http://me:secret@gpu/x", "http://gpu/?k"]
)
def test_an_url_that_is_none_or_may_hold_a_secret_is_refused_and_not_shown(url):
    with pytest.raises(InputError, match="scheme, host and path alone") as caught:
        RemoteScorer(Remote(url))
    assert "secret" not in str(caught.value)


def test_a_scenario_names_the_server_by_a_tag_and_its_pipeline_asks_it():
    with DetectionServer() as server:
        text = f"{{scorer: !Remote {{url: {server.url}/detect, timeout: 20}}, target: hammer}}"
        config = parse_scenario(
            f"pipeline: {{view_selection: {text}}}", "text", Scenario()
        ).pipeline
        scorer = make_view_scorer(config, seed=0)
        selected = select_view(
            scorer, views(), PointCloud(0), Candidates.empty(), "x", target="hammer"
        )
    assert config.view_selection.scorer == Remote(f"{server.url}/detect", 20.0)
    assert list(selected.scores) == ["wrist", "side", "away"]
    best = max(selected.scores, key=selected.scores.get)
    assert (selected.status, selected.camera) == ("ok", best)


@pytest.mark.parametrize("timeout", [0.0, -1.0, float("inf"), float("nan")])
def test_a_timeout_that_never_ends_is_refused(timeout):
    with pytest.raises(InputError, match="timeout must be above 0 s"):
        RemoteScorer(Remote(timeout=timeout))
