"""The notebooks: short, stripped, and each runs from top to bottom."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from tog_drake.visualization import inline, make_meshcat

pytest.importorskip("IPython")
NOTEBOOKS = sorted((Path(__file__).parents[1] / "notebooks").glob("*.ipynb"))
# IPython itself runs the cells, as a kernel does, and stops at the first that fails.
RUN = """
import json, sys
from IPython.core.interactiveshell import InteractiveShell
shell = InteractiveShell.instance()
shell.run_line_magic("colors", "nocolor")
for cell in json.load(open(sys.argv[1], encoding="utf-8"))["cells"]:
    if cell["cell_type"] == "code":
        result = shell.run_cell("".join(cell["source"]))
        if not result.success or shell.user_ns.get("_exit_code", 0) != 0:
            sys.exit(1)
"""


def cells_of(path):
    return json.loads(path.read_text(encoding="utf-8"))["cells"]


def test_there_are_notebooks_in_pipeline_order():
    begins = [path.name[:2] for path in NOTEBOOKS]
    assert begins == [f"{i:02d}" for i in range(1, len(NOTEBOOKS) + 1)]
    assert len(NOTEBOOKS) >= 5


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


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_runs_from_top_to_bottom_in_a_new_folder(path, tmp_path):
    done = subprocess.run(
        [sys.executable, "-c", RUN, str(path)],
        cwd=tmp_path,
        env={**os.environ, "IPYTHONDIR": str(tmp_path / "ipython")},
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]


def test_a_scene_in_a_cell_needs_no_server_unless_it_is_to_be_live():
    meshcat = make_meshcat()
    assert meshcat.web_url() in inline(meshcat, live=True).data
    still = inline(meshcat).data
    assert "<iframe srcdoc=" in still
    assert len(still) > 1_000_000
