"""The lines and files of one episode of a benchmark."""

import gzip
import io
import json

import cv2
import numpy as np
import pytest
from vlm_server import VlmServer

from tog_drake.benchmark.cells import make_cells
from tog_drake.benchmark.costs import exchanges
from tog_drake.benchmark.episodes import EpisodeWork
from tog_drake.benchmark.method import Method
from tog_drake.benchmark.processes import Broken
from tog_drake.benchmark.suite import load_suite
from tog_drake.errors import InputError
from tog_drake.judge import Judge
from tog_drake.record import OUTCOMES, EpisodeRecord


def test_an_episode_that_serves_two_tasks_is_two_lines_and_leaves_what_shows_it(tmp_path):
    (cell,) = make_cells(load_suite("Hammer"), [Method("top-score", k="3")], [0])
    result = EpisodeWork(tmp_path, replays=True)(cell)
    lines = result.lines
    assert json.loads(json.dumps(lines)) == lines
    use, handover = (line["record"] for line in lines)
    assert [line["cell"]["task"] for line in lines] == [use["task"], handover["task"]]
    assert use["task"] != handover["task"]
    assert use["held"] == handover["held"]
    assert (use["allowed"], handover["allowed"]) == (["handle"], ["head"])
    assert {use["task_compliance"], handover["task_compliance"]} == {True, False}
    assert use["counts"]["candidates"] == 3

    pictures = {
        name: cv2.imdecode(np.frombuffer(result.files[name], np.uint8), cv2.IMREAD_COLOR)
        for name in ("view.jpg", "grasp.jpg")
    }
    assert pictures["view.jpg"].shape == (480, 640, 3)
    assert pictures["grasp.jpg"].shape[0] >= 672
    with np.load(io.BytesIO(result.files["grasps.npz"])) as grasps:
        n = use["counts"]["feasible"]
        assert grasps["X_WG"].shape == (n, 4, 4)
        assert {grasps[name].shape for name in ("width", "score")} == {(n,)}
        assert grasps["p_WContact"].shape == (n, 3)
        assert int(grasps["chosen"]) == use["choice"]["index"]
        assert len(grasps["candidates"]) == 3
        assert int(grasps["chosen"]) in grasps["candidates"]
    assert b"<html" in gzip.decompress(result.files["replay.html.gz"])[:500].lower()


def test_views_to_compare_where_there_is_one_camera_are_refused_before_anything_runs(tmp_path):
    (cell,) = make_cells(load_suite("Hammer"), [Method("top-score", view="coverage")], [0])
    with pytest.raises(InputError, match=r"has one camera, wrist; valid: .* --side-cameras"):
        EpisodeWork(tmp_path).configured(cell)


def test_a_broken_episode_has_a_whole_record_and_its_traceback_in_a_file(tmp_path):
    cells = make_cells(load_suite("Mug"), [Method("random"), Method("oracle")], [0], noise=True)
    work = EpisodeWork(tmp_path)
    results = [work.broken(cell, Broken("ValueError: no", "Traceback: no")) for cell in cells]
    assert [len(result.lines) for result in results] == [2, 1, 1]
    for result in results:
        for line in result.lines:
            record = json.loads(json.dumps(line["record"]))
            assert record.keys() == EpisodeRecord.__annotations__.keys()
            assert (record["outcome"], record["message"]) == ("broken", "ValueError: no")
            assert record["combined_success"] is record["grasp_success"] is False
            assert (record["noise"], record["seed"], record["object"]) == (True, 0, "mug")
        assert result.files == {"traceback.txt": b"Traceback: no"}
    assert "broken" in OUTCOMES


def test_what_a_model_was_asked_before_the_program_failed_is_told_with_its_price(
    tmp_path, monkeypatch
):
    def fails(judge):
        raise ZeroDivisionError("one by nothing")

    monkeypatch.setattr(Judge, "start_over", fails)
    with VlmServer(lambda text, images: json.dumps({"label": "1"}), key=None) as server:
        method = Method("vlm", strategy="gsi", vlm=server.specification("openai"))
        cell = make_cells(load_suite("Hammer"), [method], [0])[0]
        result = EpisodeWork(tmp_path)(cell)
    (line,) = result.lines
    assert line["record"]["outcome"] == "broken"
    assert line["record"]["message"] == "ZeroDivisionError: one by nothing"
    (exchange,) = exchanges(line)
    assert exchange["tokens"] is not None
    assert b"in fails" in result.files["traceback.txt"]
