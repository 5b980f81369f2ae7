"""The lines and files of one episode of a benchmark."""

import gzip
import json

import cv2
import numpy as np

from tog_drake.benchmark.cells import make_cells
from tog_drake.benchmark.episodes import EpisodeWork
from tog_drake.benchmark.journal import PICTURES
from tog_drake.benchmark.method import Method
from tog_drake.benchmark.processes import Broken
from tog_drake.benchmark.suite import load_suite
from tog_drake.record import OUTCOMES, EpisodeRecord


def test_an_episode_that_serves_two_tasks_is_two_lines_and_leaves_what_shows_it(tmp_path):
    (cell,) = make_cells(load_suite("Hammer"), [Method("top-score", k="3")], [0])
    lines = EpisodeWork(tmp_path, replays=True)(cell)
    assert json.loads(json.dumps(lines)) == lines
    use, handover = (line["record"] for line in lines)
    assert [line["cell"]["task"] for line in lines] == [use["task"], handover["task"]]
    assert use["task"] != handover["task"]
    assert use["held"] == handover["held"]
    assert (use["allowed"], handover["allowed"]) == (["handle"], ["head"])
    assert {use["task_compliance"], handover["task_compliance"]} == {True, False}
    assert use["counts"]["candidates"] == 3

    folder = tmp_path / PICTURES / cell.name
    assert cv2.imread(str(folder / "view.jpg")).shape == (480, 640, 3)
    with np.load(folder / "grasps.npz") as grasps:
        n = use["counts"]["feasible"]
        assert grasps["X_WG"].shape == (n, 4, 4)
        assert {grasps[name].shape for name in ("width", "score")} == {(n,)}
        assert grasps["p_WContact"].shape == (n, 3)
        assert int(grasps["chosen"]) == use["choice"]["index"]
        assert len(grasps["candidates"]) == 3
        assert int(grasps["chosen"]) in grasps["candidates"]
    assert b"<html" in gzip.decompress((folder / "replay.html.gz").read_bytes())[:500].lower()


def test_a_broken_episode_has_a_whole_record_and_its_traceback_in_a_file(tmp_path):
    cells = make_cells(load_suite("Mug"), [Method("random"), Method("oracle")], [0], noise=True)
    work = EpisodeWork(tmp_path)
    lines = [work.broken(cell, Broken("ValueError: no", "Traceback: no")) for cell in cells]
    assert [len(of_cell) for of_cell in lines] == [2, 1, 1]
    for cell, of_cell in zip(cells, lines, strict=True):
        for line in of_cell:
            record = json.loads(json.dumps(line["record"]))
            assert record.keys() == EpisodeRecord.__annotations__.keys()
            assert (record["outcome"], record["message"]) == ("broken", "ValueError: no")
            assert record["combined_success"] is record["grasp_success"] is False
            assert (record["noise"], record["seed"], record["object"]) == (True, 0, "mug")
        traceback = tmp_path / PICTURES / cell.name / "traceback.txt"
        assert traceback.read_text() == "Traceback: no"
    assert "broken" in OUTCOMES
