"""Grasps from a server: the protocol, both ends of it, and servers and clients that misbehave."""

import contextlib
import http.client
import json
import socket
import textwrap
import threading
import time
from dataclasses import replace
from http.server import BaseHTTPRequestHandler, HTTPServer
from io import StringIO

import numpy as np
import pytest
import vlm_server as mishaps
from command import refused, tog
from loopback import LoopbackServer
from rich.console import Console
from synthetic_weights import write_checkpoint
from tabletop import RED, TABLE, look

from tog_drake import http_post
from tog_drake.cloud import CloudConfig, scene_cloud
from tog_drake.decision import Decision
from tog_drake.errors import InputError, NoGrasp, NoProposal
from tog_drake.grasp_check import check_grasps, turned
from tog_drake.pipeline import PipelineConfig
from tog_drake.proposers import propose_protocol, serving
from tog_drake.proposers.answered import Answerer, answerer_of
from tog_drake.proposers.antipodal import Antipodal, AntipodalProposer
from tog_drake.proposers.propose_protocol import (
    SCHEMA,
    BadRequest,
    Request,
    answer_body,
    read_request,
    request_body,
)
from tog_drake.proposers.remote import Remote, RemoteProposer
from tog_drake.proposers.serving import ProposerServer
from tog_drake.record import new_record
from tog_drake.report import EpisodeReport, report_html
from tog_drake.scenario import Scenario, parse_scenario
from tog_drake.serve_commands import proposals
from tog_drake.terminal import print_origins
from tog_drake.values import Grasps, Workspace

TESTED = Answerer("tested")
WHO = Answerer("tested", "not the <released> ones\x1b[2J", "0f" * 32)
QUICK = Antipodal(anchors=40, max_anchors=40, tilts_deg=[40.0])
RUN = ("run", "--no-meshcat", "--task", "use the hammer")


@pytest.fixture(autouse=True)
def no_waiting(monkeypatch):
    monkeypatch.setattr(http_post, "FIRST_DELAY", 0.001)


@pytest.fixture(scope="module")
def scene():
    """A view and its cloud: a block on a table."""
    view = look([TABLE, ((0.44, -0.02, 0.0), (0.56, 0.02, 0.06), RED)])
    return view, scene_cloud([view], Workspace(), CloudConfig())


@pytest.fixture(scope="module")
def grasps(scene):
    view, seen = scene
    return AntipodalProposer(QUICK, Workspace(), 3).propose(seen, view)


@contextlib.contextmanager
def serving_by(propose, answerer=TESTED):
    """A ProposerServer while the ``with`` lasts; yields its port and the lines that it said."""
    said = []
    server = ProposerServer(("127.0.0.1", 0), answerer, propose, said.append)
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    try:
        yield server.server_port, said
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


def remote(port, *, timeout=20.0, seed=3, path="/propose", **settings):
    config = Remote(f"http://127.0.0.1:{port}{path}", timeout, **settings)
    return RemoteProposer(config, Workspace(), seed)


def same(mine, theirs):
    for name, expected in vars(theirs).items():
        np.testing.assert_array_equal(getattr(mine, name), expected)


# --- both ends together -------------------------------------------------------------------------


def test_grasps_from_a_server_are_those_of_the_proposer_bit_for_bit(scene, grasps):
    view, seen = scene
    config = PipelineConfig(proposer=QUICK)
    with serving_by(proposals(config)) as (port, said):
        same(remote(port).propose(seen, view), grasps)
        same(remote(port, images=False).propose(seen, view), grasps)
        other_seed = remote(port, seed=4).propose(seen, view)
    assert not np.array_equal(other_seed.X_WG[:5], grasps.X_WG[:5])
    assert len(said) == 3
    assert f"200: {len(grasps)} grasps on {seen.size()} points" in said[0]


def test_what_a_network_says_in_single_precision_comes_through_bit_for_bit(scene, grasps):
    view, seen = scene
    said = replace(grasps, X_WG=grasps.X_WG.astype(np.float32).astype(np.float64))
    far = replace(said, X_WG=said.X_WG + np.outer(np.eye(4)[0], np.eye(4)[3]))  # nothing is there
    with serving_by(lambda request: said) as (port, _):
        same(remote(port).propose(seen, view), said)
    with (
        serving_by(lambda request: far) as (port, _),
        pytest.raises(NoProposal, match=r"grasps have nothing .*'world'.*'G'"),
    ):
        remote(port).propose(seen, view)


def test_the_grasps_of_a_server_hold_the_block(scene):
    view, seen = scene
    with serving_by(proposals(PipelineConfig(proposer=QUICK))) as (port, _):
        grasps = remote(port).propose(seen, view)
    assert check_grasps(grasps, seen).count("") > 0.8 * len(grasps)
    assert "" not in check_grasps(turned(grasps, 90), seen)


def test_a_request_arrives_as_it_was_sent(scene):
    view, seen = scene
    workspace = Workspace([0.1, -0.2, 0.0], [0.7, 0.3, 0.5], 0.05)
    sent = Request(seen, view, workspace, 7)
    text = json.dumps(request_body(sent, images=True), allow_nan=False)
    got = read_request(json.loads(text))
    for field in ("xyzs", "normals", "rgbs"):
        np.testing.assert_array_equal(getattr(got.cloud, field)(), getattr(seen, field)())
    same(got.view, view)
    assert (got.workspace, got.seed) == (workspace, 7)
    without = read_request(request_body(sent, images=False)).view
    assert not without.depth.any()
    assert without.depth.shape == view.depth.shape
    assert without.intrinsics == view.intrinsics


def test_the_server_in_the_protocols_description_works(scene, grasps):
    program = textwrap.dedent(
        propose_protocol.__doc__.split("whole::")[1].split("What is wrong")[0]
    )
    *_, last = program.strip().splitlines()
    assert last == 'HTTPServer(("127.0.0.1", 8001), Handler).serve_forever()'
    asked = []

    def my_network(points):
        asked.append(points)
        base = np.eye(4)
        base[2, 3] = -0.1034  # franka_hand
        return grasps.X_WG @ base, grasps.score

    namespace = {"my_network": my_network}
    exec(program.replace(last, ""), namespace)
    assert namespace["HTTPServer"] is HTTPServer
    view, seen = scene
    with LoopbackServer(namespace["Handler"]) as server:
        found = remote(server.port).propose(seen, view)
    np.testing.assert_array_equal(asked[0], seen.xyzs().T)
    assert len(found) == len(grasps)
    np.testing.assert_allclose(found.X_WG, grasps.X_WG, atol=1e-9)


def test_no_grasps_are_an_answer_and_what_a_proposer_says_is_passed_on(scene):
    view, seen = scene
    with serving_by(lambda request: Grasps.empty()) as (port, _):
        assert len(remote(port).propose(seen, view)) == 0

    def nothing(request):
        raise NoGrasp("it is all too wide")

    with serving_by(nothing) as (port, _), pytest.raises(NoProposal, match=r"422.*all too wide"):
        remote(port).propose(seen, view)

    def defect(request):
        raise KeyError("weights")

    with serving_by(defect) as (port, _), pytest.raises(NoProposal, match=r"500.*KeyError"):
        remote(port).propose(seen, view)

    bad = Grasps(np.full((1, 4, 4), np.nan), np.zeros(1), np.zeros(1), np.zeros((1, 3)))
    with serving_by(lambda request: bad) as (port, _), pytest.raises(NoProposal, match="500"):
        remote(port).propose(seen, view)


def test_one_proposal_is_made_at_a_time(scene, grasps):
    view, seen = scene
    running, most = [], []

    def propose(request):
        running.append(1)
        most.append(len(running))
        time.sleep(0.05)
        running.pop()
        return grasps

    with serving_by(propose) as (port, _):
        askers = [
            threading.Thread(target=remote(port, images=False).propose, args=(seen, view))
            for _ in range(4)
        ]
        for asker in askers:
            asker.start()
        for asker in askers:
            asker.join()
    assert most == [1, 1, 1, 1]


def test_a_server_without_https_is_not_told_to_start(scene, grasps):
    view, seen = scene
    with GraspServer(grasps.take(np.arange(N))) as server:
        proposer = RemoteProposer(Remote(f"https://127.0.0.1:{server.port}/x"), Workspace(), 3)
        with pytest.raises(NoProposal, match=r"does not speak https; is it http://\?$"):
            proposer.propose(seen, view)


def test_who_proposed_is_what_the_server_says_and_is_shown_as_that(scene, grasps):
    view, seen = scene
    few = grasps.take(np.arange(N))
    with serving_by(lambda request: few, WHO) as (port, _):
        near = remote(port).propose(seen, view)
        with serving_by(remote_again(port), Answerer("remote")) as (further, _):
            far = remote(further).propose(seen, view).take(np.arange(1))
    assert near.answerer == WHO
    assert far.answerer == replace(WHO, name="tested by remote")
    with GraspServer(few, says(proposer=None)) as server:
        untold = remote(server.port).propose(seen, view)
    assert untold.answerer is None

    config = PipelineConfig(proposer=Remote("http://gpu:8001/propose"))
    shown = {}
    for name, of in {"told": near, "untold": untold, "own": grasps}.items():
        record = new_record(Decision(grasps=of), config, task="t", seed=0)
        out = StringIO()
        print_origins(Console(file=out, width=80), [record["proposer"]] * 2)
        shown[name] = (record["proposer"], out.getvalue(), report_html([EpisodeReport(record)]))
    told, line, page = shown["told"]
    assert told["answered_by"] == {"name": WHO.name, "note": WHO.note, "sha256": WHO.sha256}
    assert line.startswith("proposer: http://gpu:8001/propose says that it is tested, sha256 0f0f")
    assert line.count("\n") == 1 and "not the <released> ones" in line and "\x1b" not in line
    assert "the server says that it is tested, not the &lt;released&gt; ones" in page
    assert "\x1b" not in page
    none, line, page = shown["untold"]
    assert none["answered_by"] is None
    assert "does not say what proposes there" in line
    assert "does not say what proposes there" in page
    assert "answered_by" not in shown["own"][0]
    assert shown["own"][1] == "proposer: remote:http://gpu:8001/propose\n"


def remote_again(port):
    return lambda request: remote(port).propose(request.cloud, request.view)


def test_a_server_with_a_network_says_which_weights_it_has():
    weights = {"file": "/home/me/w.pt", "sha256": "ab" * 32, "note": "not the released ones"}
    said = answerer_of("contact-graspnet", weights)
    assert said == Answerer("contact-graspnet", "not the released ones", "ab" * 32)
    assert answerer_of("x" * 500, None).name == "x" * 100


def test_a_scenario_names_the_server_by_a_tag():
    text = 'pipeline: {proposer: !Remote {url: "http://gpu:8001/propose", timeout: 5}}'
    config = parse_scenario(text, "text", Scenario()).pipeline
    assert config.proposer == Remote("http://gpu:8001/propose", 5.0, True)


# --- servers that misbehave ---------------------------------------------------------------------


class GraspServer(LoopbackServer):
    """Meets each request with a mishap of ``vlm_server``; without one it answers well."""

    def __init__(self, grasps, mishap=None):
        super().__init__(_Handler)
        self.answer = answer_body(grasps, WHO)
        self.mishap = mishap
        self.headers = []


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
        owner.headers.append(dict(self.headers))
        self.rfile.read(int(self.headers["Content-Length"]))
        with contextlib.suppress(OSError):
            if owner.mishap is None:
                self.send(200, self.good())
            else:
                owner.mishap(self, None)

    def good(self, spoken=None):
        return json.dumps(self.server.owner.answer).encode()


def says(**changes):
    """A good answer with other entries."""

    def mishap(handler, spoken):
        handler.send(200, json.dumps({**handler.server.owner.answer, **changes}).encode())

    return mishap


def _endless(handler, spoken):
    handler.send_head(200, None)
    block = b" " * 2**16
    while not handler.server.owner.closing.is_set():
        handler.wfile.write(b"%x\r\n%s\r\n" % (len(block), block))


N = 3  # grasps in a good answer
NAN = json.dumps([float("nan")] * N).encode()
HOSTILE = {
    "hangs": (mishaps.hang, "timed_out", "allow more than 0.3 s"),
    "drips": (mishaps.trickle, "timed_out", "within the deadline"),
    "drips headers": (mishaps.trickle_headers, "timed_out", "within the deadline"),
    "endless": (_endless, "too_long", "longer than"),
    "huge": (mishaps.verbatim(b"[" + b"1," * 2**22 + b"1]"), "too_long", "longer than"),
    "a million grasps": (
        says(scores=[0.5] * 1_000_000), "too_long", "longer",
    ),
    "too many grasps": (
        says(poses=[[[1]]] * 2001, scores=[0.5] * 2001), "unreadable", "at most 2000",
    ),
    "a page": (mishaps.html(), "unreachable", "something else than JSON"),
    "an error page": (mishaps.html(502), "unreachable", "status 502"),
    "no json": (mishaps.verbatim(b"\x00\xff\xfe"), "unreachable", "something else than JSON"),
    "nan": (mishaps.verbatim(b'{"schema": NaN}'), "unreachable", "something else than JSON"),
    "deep": (mishaps.verbatim(b"[" * 100_000), "unreachable", "something else than JSON"),
    "deep but closed": (
        mishaps.verbatim(b"[" * 500 + b"]" * 500), "unreachable", "something else than JSON",
    ),
    "a redirect": (mishaps.redirect("http://127.0.0.1:1/"), "rejected", "redirects"),
    "cut": (mishaps.cut, "unreachable", "tog serve proposer"),
    "cut in chunks": (mishaps.cut_chunked, "unreachable", "cut in the answer"),
    "reset": (mishaps.reset, "unreachable", "is it running"),
    "no http": (mishaps.raw(b"SSH-2.0-OpenSSH_9\r\n\r\n"), "unreachable", "no connection"),
    "refuses": (mishaps.verbatim(b'{"error": {"message": "no"}}', 400), "rejected", '400: "no"'),
    "is elsewhere": (
        mishaps.verbatim(b'{"error": {"message": "no"}}', 404),
        "rejected", r'404: "no"; is the URL right \(of `tog serve proposer` it ends in /propose\)',
    ),
    "a list": (mishaps.verbatim(b"[]"), "unreadable", "its schema is none"),
    "another schema": (says(schema="grasps/9"), "unreadable", "'grasps/9'; valid: 'tog_drake"),
    "no poses": (says(poses=None), "unreadable", "has no poses"),
    "numbers as text": (says(scores=["0.5"] * N), "unreadable", r"scores\[0\] is '0.5'"),
    "flat poses": (says(poses=[[1.0] * 16] * N), "unreadable", r"poses\[0\] is a list of 16"),
    "mirrored": (
        says(poses=[np.diag([1.0, 1, -1, 1]).tolist()] * N), "unreadable", "no rigid transform",
    ),
    "one score": (says(scores=[0.5]), "unreadable", "scores is for 1 grasps"),
    "sure beyond measure": (says(scores=[2.0] * N), "unreadable", r"scores\[0\] is 2"),
    "another frame": (says(frame="base"), "unreadable", "unknown frame 'base'"),
    "nobody": (says(proposer={"name": ""}), "unreadable", "proposer has no name"),
    "who at length": (says(proposer={"name": "x" * 101}), "unreadable", "name .* too long; valid"),
    "who in numbers": (says(proposer={"name": "x", "note": 3}), "unreadable", "note .* no text"),
    "who in a list": (says(proposer=["x"]), "unreadable", "its proposer is a list"),
    "who and more": (says(proposer={"name": "x", "file": "y"}), "unreadable", "holds 'file'"),
    "no sum": (says(proposer={"name": "x", "sha256": "0"}), "unreadable", "64 hexadecimal"),
    "an escape in it": (says(frame="\x1b[2J"), "unreadable", r"unknown frame '\\x1b"),
}  # fmt: skip


@pytest.mark.parametrize("case", HOSTILE)
def test_whatever_a_server_does_it_is_over_in_time_and_says_what_was_wrong(case, scene, grasps):
    mishap, status, message = HOSTILE[case]
    view, seen = scene
    timeout = 0.3 if status == "timed_out" else 20.0
    with GraspServer(grasps.take(np.arange(N)), mishap) as server:
        with pytest.raises(NoProposal, match=message) as caught:
            remote(server.port, timeout=timeout, images=False).propose(seen, view)
        asked = len(server.headers)
    assert caught.value.status == status
    assert caught.value.outcome == "no_proposal"
    assert f"http://127.0.0.1:{server.port}/propose" in str(caught.value)
    # Only a connection that failed is tried once more; no time is left for it after a deadline.
    again = case in ("cut", "cut in chunks", "reset", "no http")
    assert asked == 2 if again else asked <= 1


def test_nothing_is_sent_that_tells_who_asks(scene, grasps, tmp_path, monkeypatch):
    (tmp_path / "netrc").write_text("machine 127.0.0.1 login me password planted-secret")
    monkeypatch.setenv("NETRC", str(tmp_path / "netrc"))
    mishaps.plant_keys(monkeypatch)
    view, seen = scene
    with GraspServer(grasps.take(np.arange(N))) as server:
        assert len(remote(server.port, images=False).propose(seen, view)) == N
    (headers,) = server.headers
    assert {name.lower() for name in headers} <= {
        "host", "user-agent", "accept", "accept-encoding", "connection", "content-type",
        "content-length",
    }  # fmt: skip


@pytest.mark.parametrize(
    "url", ["", "gpu:8001", "ftp://gpu/x", "http://me:secret@gpu/x", "http://gpu/x?key=secret"]
)
def test_an_url_that_is_none_or_holds_a_secret_is_refused_and_not_repeated(url, tmp_path):
    with pytest.raises(InputError, match="no URL of scheme, host and path alone") as caught:
        RemoteProposer(Remote(url), Workspace(), 0)
    assert "secret" not in str(caught.value)
    with pytest.raises(InputError, match="timeout must be above 0 s, not nan"):
        RemoteProposer(Remote(timeout=float("nan")), Workspace(), 0)
    if "me:secret" in url:
        done = tog(*RUN, "--proposer", f"remote:{url}", "--out", tmp_path / "out")
        refused(done, "http://127.0.0.1:8001/propose")


def test_a_run_whose_server_is_not_there_says_so_and_what_to_do(tmp_path):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        url = f"http://127.0.0.1:{free.getsockname()[1]}/propose"  # nobody listens
        done = tog(*RUN, "--proposer", f"remote:{url}", "--json", "--out", tmp_path / "out")
    record = json.loads(done.out)
    assert (done.status, record["outcome"]) == (1, "no_proposal")
    assert "is it running?; `tog serve proposer` there starts one" in record["message"]
    assert record["proposer"] == {"kind": "remote", "url": url, "timeout": 60.0, "images": True}


# --- clients that misbehave ---------------------------------------------------------------------


@pytest.fixture(scope="module")
def listening(grasps):
    with serving_by(lambda request: grasps) as (port, _):
        yield port


@pytest.fixture(scope="module")
def body(scene):
    view, seen = scene
    return request_body(Request(seen, view, Workspace(), 0), images=True)


def asked(port, method, path, data=None, **headers):
    """The status and the JSON of an answer."""
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=20)
    with contextlib.closing(connection):
        connection.request(method, path, data, {"Content-Type": "application/json", **headers})
        response = connection.getresponse()
        assert response.headers["Content-Type"] == "application/json"
        return response.status, json.loads(response.read())


def test_healthz_tells_who_answers(listening):
    status, told = asked(listening, "GET", "/healthz")
    assert (status, told) == (200, {"status": "ok", "schema": SCHEMA, "proposer": "tested"})


@pytest.mark.parametrize(
    ("method", "path", "data", "headers", "status"),
    [
        ("GET", "/", None, {}, 404),
        ("GET", "/../etc/passwd", None, {}, 404),
        ("POST", "/", b"{}", {}, 404),
        ("PUT", "/propose", b"{}", {}, 501),
        ("POST", "/propose", b"{}", {"Content-Type": "text/plain"}, 415),
        ("POST", "/propose", None, {"Content-Length": "many"}, 411),
        ("POST", "/propose", None, {"Content-Length": "-1"}, 411),
        ("POST", "/propose", None, {"Content-Length": "9" * 11}, 413),
        ("POST", "/propose", None, {"Content-Length": "9" * 5000}, 413),
        ("POST", "/propose", b"{", {}, 400),
        ("POST", "/propose", b"[" * 100_000, {}, 400),
        ("POST", "/propose", b"\xff", {}, 400),
    ],
)
def test_what_is_no_request_gets_a_status_and_json(method, path, data, headers, status, listening):
    got, told = asked(listening, method, path, data, **headers)
    assert got == status
    assert told["error"]["message"]


def _change(body, name, **changes):
    return {**body, name: {**body[name], **changes}}


BAD = {
    "schema": (lambda b: {**b, "schema": "x"}, "no request of"),
    "a list": (lambda b: [b], "no request of"),
    "no points": (lambda b: {**b, "points": None}, "points is no array of float32"),
    "doubles": (lambda b: _change(b, "points", dtype="float64"), "points is no array of float32"),
    "objects": (lambda b: _change(b, "points", dtype="object"), "points is no array"),
    "flat": (lambda b: _change(b, "points", shape=[12]), "points has the shape"),
    "negative": (lambda b: _change(b, "points", shape=[-1, 3]), "points has the shape"),
    "true": (lambda b: _change(b, "points", shape=[True, 3]), "points has the shape"),
    "a million": (lambda b: _change(b, "points", shape=[10**9, 3]), "at most 1000000"),
    "fewer normals": (lambda b: _change(b, "normals", shape=[1, 3]), "normals has the shape"),
    "too little": (lambda b: _change(b, "points", base64="AAAA"), "points has 3 bytes"),
    "no base64": (lambda b: _change(b, "points", base64="%%%%"), "points is not base64"),
    "a number": (lambda b: _change(b, "points", base64=7), "points is not base64"),
    "nan": (
        lambda b: _change(b, "points", base64="AADAfwAAwH8AAMB/", shape=[1, 3]), "not finite",
    ),
    "no camera": (lambda b: {**b, "camera": None}, "camera must be an object"),
    "a camera of lists": (lambda b: _change(b, "camera", fx=[1, 2]), "fx must be finite numbers"),
    "a huge camera": (lambda b: _change(b, "camera", width=1e9), "pixels; valid: at most"),
    "no focus": (lambda b: _change(b, "camera", fx=0), "fx and fy must be above 0"),
    "another size": (lambda b: _change(b, "camera", width=100), "rgb has the shape"),
    "no pose": (lambda b: {**b, "X_WC": None}, "X_WC"),
    "a mirror": (lambda b: {**b, "X_WC": np.diag([1, 1, -1, 1]).tolist()}, "no rigid transform"),
    "a workspace": (lambda b: {**b, "workspace": {"lower": [0]}}, "lower must be finite"),
    "texts": (lambda b: _change(b, "camera", width="640"), "width is missing or no numbers"),
    "truth": (lambda b: _change(b, "camera", fx=True), "fx is missing or no numbers"),
    "truth in a list": (
        lambda b: _change(b, "workspace", lower=[True, 0.0, 0.0]), "lower is missing or no numbers",
    ),
    "upside down": (lambda b: _change(b, "workspace", lower=[0, 0, 9.0]), "is above upper"),
    "a seed": (lambda b: {**b, "seed": -1}, "seed is -1"),
    "half a seed": (lambda b: {**b, "seed": 0.5}, "seed is 0.5"),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD)
def test_a_request_that_is_wrong_is_refused_and_says_where(case, body):
    change, message = BAD[case]
    with pytest.raises(BadRequest, match=message):
        read_request(json.loads(json.dumps(change(body))))


def test_what_is_wrong_reaches_the_client_with_status_400(listening, body):
    status, told = asked(listening, "POST", "/propose", json.dumps({**body, "seed": -1}))
    assert (status, told["error"]["message"]) == (400, "seed is -1; valid: a whole number from 0")


def test_a_client_that_falls_silent_is_given_up(listening, monkeypatch):
    monkeypatch.setattr(serving._Handler, "timeout", 0.2)
    with socket.create_connection(("127.0.0.1", listening), timeout=20) as client:
        client.sendall(
            b"POST /propose HTTP/1.1\r\nContent-Type: application/json\r\n"
            b"Content-Length: 100\r\n\r\n{"
        )
        assert b"408" in client.recv(100)
    with socket.create_connection(("127.0.0.1", listening), timeout=20) as client:
        client.sendall(b"POST /propose HTTP/1.1\r\nX-Slow: ")
        assert client.recv(100) == b""


@pytest.mark.parametrize("end", [b"", b"\r\n"], ids=["in its headers", "in its body"])
def test_a_client_that_drips_is_given_up(end, listening, monkeypatch):
    monkeypatch.setattr(serving, "READING", 0.3)
    with socket.create_connection(("127.0.0.1", listening), timeout=0.02) as client:
        client.sendall(b"POST /propose HTTP/1.1\r\nContent-Length: 9999\r\n" + end)
        for _ in range(1000):
            try:
                client.sendall(b"x")
                assert client.recv(100)[9:12] in (b"", b"408")
            except TimeoutError:
                continue
            except ConnectionError:  # it hung up while this end was sending
                pass
            return
    pytest.fail("it was not given up")


def test_more_clients_than_there_is_room_for_are_turned_away_and_room_is_made_again(
    listening, monkeypatch
):
    idle = [socket.create_connection(("127.0.0.1", listening)) for _ in range(serving.MAX_CLIENTS)]
    with socket.create_connection(("127.0.0.1", listening), timeout=20) as one_more:
        assert one_more.recv(100) == b""
    for client in idle:
        client.close()
    for _ in range(200):
        with contextlib.suppress(OSError, http.client.HTTPException):
            assert asked(listening, "GET", "/healthz")[0] == 200
            return
        time.sleep(0.05)
    pytest.fail("no room was made again")


# --- the command --------------------------------------------------------------------------------


def test_a_server_that_cannot_start_is_one_line(tmp_path):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        done = tog("serve", "proposer", "--port", port)
        refused(done, f"cannot listen on 127.0.0.1:{port}", "another --port")
    refused(tog("serve", "proposer", "--proposer", "gpd"), "'gpd'", "antipodal")
    refused(tog("serve", "proposer", "--host", "no such host"), "cannot listen on no such host")


@pytest.fixture
def unheard(monkeypatch):
    """A server that ends as soon as it has said what it says."""
    for name in ("serve_forever", "server_bind", "server_activate"):
        monkeypatch.setattr(ProposerServer, name, lambda server: None)
    monkeypatch.setattr(ProposerServer, "server_port", 8001, raising=False)


def test_a_server_for_others_says_that_anybody_can_use_it(unheard):
    at_home, for_all = (tog("serve", "proposer", "--host", h) for h in ("127.0.0.1", "0.0.0.0"))
    assert at_home.status == for_all.status == 0
    assert "http://127.0.0.1:8001/propose" in at_home.out
    assert "anybody" not in at_home.out
    assert "anybody who reaches 0.0.0.0 on the network can use it" in for_all.out


def test_a_server_takes_the_settings_of_its_proposer(unheard):
    text = "{pipeline: {proposer: !Antipodal {yaws: %s}}}"
    done = tog("serve", "proposer", "--scenario-text", text % 2)
    assert done.status == 0, done.err
    assert "proposer antipodal: " in done.out
    refused(tog("serve", "proposer", "--scenario-text", text % 0), "yaws at least 1")
    refused(tog("serve", "proposer", "--scenario-text", "{pipe: 1}"), "--scenario-text", "pipe")


def test_a_server_says_whose_weights_it_has(unheard, tmp_path):
    write_checkpoint(tmp_path / "synthetic.pt")
    done = tog("serve", "proposer", "--checkpoint", tmp_path / "synthetic.pt")
    assert done.status == 0, done.err
    assert "synthetic.pt, not the released checkpoint" in done.out
    assert "proposer contact-graspnet: http://127.0.0.1:8001/propose" in done.out
