"""The notebooks: short, stripped, and each runs from top to bottom as Jupyter runs it."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from tog_drake.errors import InputError
from tog_drake.visualization import inline, make_meshcat

NOTEBOOKS = sorted((Path(__file__).parents[1] / "notebooks").glob("*.ipynb"))
# A kernel in a process of its own runs the cells, and stops at the first that fails. What they
# print is kept, a command's exit status in it.
RUN = """
import json, sys
import nbformat
from nbclient import NotebookClient
notebook = nbformat.read(sys.argv[1], as_version=4)
for cell in notebook.cells:
    if cell.cell_type == "code" and "!{TOG}" in cell.source:
        cell.source += "\\nassert _exit_code == 0, 'the last command failed'"
NotebookClient(notebook, timeout=300, kernel_name="python3").execute()
nbformat.validate(notebook)
nbformat.write(notebook, sys.argv[2])
"""
LEAVES = {  # what a notebook leaves behind it, and words that its last outputs hold
    "01_scene": ([], ["image/png"]),
    "02_grasps": ([], ["no_ik", "image/png"]),
    "03_choice": (["out/asked/index.html", "out/panel/episode.json"], ["lifted", "1 pending"]),
    "04_motion": (["out/mug/episode.json"], ["'outcome': 'lifted'", "iframe"]),
    "05_benchmark": (["out/eval/report.html"], ["geometric", "report.html"]),
    "06_your_own": (["out/own/episodes.jsonl"], ["lies still", "''", "handle", "It may be hot."]),
}


def cells_of(path):
    return json.loads(path.read_text(encoding="utf-8"))["cells"]


def test_there_are_notebooks_in_pipeline_order():
    assert [path.stem for path in NOTEBOOKS] == list(LEAVES)


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_is_short_stripped_and_says_first_how_to_install(path):
    cells = cells_of(path)
    assert len(cells) <= 12
    assert "pip install" in "".join(cells[0]["source"])
    for cell in cells:
        assert cell["source"]
        if cell["cell_type"] == "code":
            assert cell["outputs"] == []
            assert cell["execution_count"] is None


def test_ones_own_object_proposer_prompt_and_suite_are_less_than_forty_lines():
    code = [c for c in cells_of(NOTEBOOKS[-1]) if c["cell_type"] == "code"]
    lines = [line for cell in code for line in "".join(cell["source"]).splitlines() if line]
    assert len([line for line in lines if not line.startswith(("import ", "from "))]) < 40


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_runs_from_top_to_bottom_in_a_new_folder(path, tmp_path):
    done = subprocess.run(
        [sys.executable, "-c", RUN, str(path), str(tmp_path / "run.ipynb")],
        cwd=tmp_path,
        env={
            **os.environ,
            "IPYTHONDIR": str(tmp_path / "ipython"),
            "JUPYTER_PREFER_ENV_PATH": "1",  # this environment's kernel, not another one's
            "TOG_ASSETS": str(tmp_path / "assets"),
        },
        capture_output=True,
        text=True,
        timeout=400,
    )
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
    files, words = LEAVES[path.stem]
    for file in files:
        assert (tmp_path / file).is_file(), file
    outputs = str([cell.get("outputs") for cell in cells_of(tmp_path / "run.ipynb")])
    for word in words:
        assert word in outputs, word


def test_a_scene_in_a_cell_needs_no_server_unless_it_is_to_be_live():
    meshcat = make_meshcat()
    assert meshcat.web_url() in inline(meshcat, live=True).data
    still = inline(meshcat).data
    assert "<iframe srcdoc=" in still
    assert len(still) > 1_000_000


def test_without_ipython_a_cell_says_how_to_install_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "IPython.display", None)
    with pytest.raises(InputError, match=r"pip install 'tog_drake\[notebooks\]'"):
        inline(make_meshcat())
