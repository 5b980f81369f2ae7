"""What the documents say: commands run, links lead somewhere, tables are complete."""

import os
import re
import subprocess
import sys
from typing import get_args
from urllib.parse import unquote, urlsplit

import pytest
import yaml
from command import checked, tog
from documents import ROOT, anchors, blocks, commands, documents, first_column, links, markdown_of
from own_network import in_own_network, needs_own_network

from tog_drake.feasibility import REASONS
from tog_drake.record import OUTCOMES
from tog_drake.safety import StopReason
from tog_drake.values import ChoiceStatus

OUTCOMES_PAGE = (ROOT / "docs" / "outcomes.md").read_text(encoding="utf-8")
README_BLOCKS = [
    block
    for block in blocks((ROOT / "README.md").read_text(encoding="utf-8"))
    if block.language in ("bash", "console", "python")
]
NOT_RUN = {"tog_drake": "it installs, and runs these tests"}  # heading -> why
OWN_NETWORK = ("Your vision-language model", "Your robot")  # they name a server, or send messages
NAMES = [str(path.relative_to(ROOT)) for path in documents()]


# --- commands and programs ----------------------------------------------------------------------


@pytest.fixture
def fresh(tmp_path, monkeypatch):
    """A new folder, with ``tog`` on the path."""
    there = tmp_path / "bin"
    there.mkdir()
    (there / "tog").write_text(f'#!/bin/sh\nexec "{sys.executable}" -m tog_drake.cli "$@"\n')
    (there / "tog").chmod(0o755)
    monkeypatch.setenv("PATH", f"{there}{os.pathsep}{os.environ['PATH']}")
    (tmp_path / "fresh").mkdir()
    return tmp_path / "fresh"


@pytest.mark.parametrize(
    "block",
    [
        pytest.param(
            block, id=block.heading, marks=needs_own_network if block.heading in OWN_NETWORK else ()
        )
        for block in README_BLOCKS
    ],
)
def test_what_the_readme_says_runs_in_a_fresh_folder(block, fresh):
    if block.heading in NOT_RUN:
        pytest.skip(f"README.md, line {block.line}: {NOT_RUN[block.heading]}")
    script = fresh.parent / "block.sh"
    script.write_text("\n".join(commands(block)))
    if block.heading in OWN_NETWORK:
        done = in_own_network("block_session.py", script, fresh, timeout=600)
    else:
        done = subprocess.run(
            ["bash", "-euo", "pipefail", script],
            cwd=fresh,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            timeout=600,
            check=False,
        )
    said = done.stdout + done.stderr
    if done.returncode == 1 and re.search(r"status is [\d.]+ s old|no image of the last", said):
        pytest.skip("needs a computer that keeps up with real time")
    assert done.returncode == 0, said


def test_all_of_the_readme_that_is_to_be_typed_is_typed_here():
    headings = [block.heading for block in README_BLOCKS]
    assert {*NOT_RUN, *OWN_NETWORK} < set(headings)
    assert {block.language for block in README_BLOCKS} == {"bash"}
    assert len(headings) == len(set(headings)) >= 6


@pytest.mark.parametrize("name", [name for name in NAMES if name.endswith(".md")])
def test_every_command_of_a_document_is_one_that_can_be_typed(name):
    for block in blocks((ROOT / name).read_text(encoding="utf-8")):
        for line in commands(block):
            if line.startswith("tog ") and " ..." not in line:
                checked(re.split(r" \| | > | &(?: |$)", line)[0])


def test_a_command_that_cannot_be_typed_is_noticed():
    with pytest.raises(Exception, match="No such option"):
        checked("tog run --tsak 'hand me the hammer'")
    with pytest.raises(AssertionError, match="no command"):
        checked("tog rnu --task 'hand me the hammer'")


# --- links --------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", NAMES)
def test_every_link_leads_somewhere(name):
    broken = {link for link in links(markdown_of(ROOT / name)) if _broken(ROOT / name, link)}
    assert not broken


def _broken(document, link):
    """Whether a file or heading is missing; of another site the form alone is looked at."""
    parts = urlsplit(link)
    if parts.scheme:
        return parts.scheme not in ("http", "https") or "." not in parts.netloc
    path = document.parent / unquote(parts.path) if parts.path else document
    if not path.resolve().is_relative_to(ROOT) or not path.exists():
        return True
    return bool(parts.fragment) and parts.fragment not in anchors(markdown_of(path))


def test_a_link_to_nowhere_is_noticed(tmp_path):
    page = ROOT / "diagrams" / "README.md"
    page_of = "../docs/outcomes.md"
    good = [page_of, f"{page_of}#rules-of-safety", "#on-a-real-panda", "https://a.org/b"]
    bad = ["outcomes.md", f"{page_of}#rules", "#on-a-real-ur5", "/etc/passwd", "http:/a.org"]
    assert [link for link in (*good, *bad) if _broken(page, link)] == bad


# --- outcomes, statuses, rules ------------------------------------------------------------------


@pytest.mark.parametrize(
    ("heading", "known"),
    [
        ("Outcomes", OUTCOMES),
        ("Why grasps are rejected", REASONS),
        ("Why there is no choice", get_args(ChoiceStatus)),
        ("Rules of safety", [rule.value for rule in StopReason]),
    ],
)
def test_the_page_of_outcomes_lists_what_the_program_has_and_nothing_else(heading, known):
    assert sorted(first_column(OUTCOMES_PAGE, heading)) == sorted(known)


def test_the_page_of_outcomes_lists_the_exit_statuses_that_the_help_names():
    told = " ".join(tog("--help").out.split()).split("Exit status: ")[1]
    assert first_column(OUTCOMES_PAGE, "Exit statuses") == re.findall(r"\b\d+\b", told)


def test_every_row_of_the_page_of_outcomes_says_what_to_do():
    for line in OUTCOMES_PAGE.splitlines():
        if line.startswith("|"):
            assert all(cell.strip() for cell in line.strip("|").split("|")), line


# --- the project's papers -----------------------------------------------------------------------


def test_citation_changelog_and_package_are_of_one_version():
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    project = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    (version,) = re.findall(r'^version = "(.+)"', project, re.M)
    assert citation["version"] == version
    changes = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    assert re.findall(r"^## (\d+\.\d+\.\d+)", changes, re.M)[0] == version


def test_a_pull_request_is_tested_with_what_the_tests_want():
    workflow = (ROOT / ".github" / "workflows" / "test.yml").read_text(encoding="utf-8")
    script = (ROOT / ".ci" / "run").read_text(encoding="utf-8")
    (wanted,) = re.findall(r"wanted=\((.+)\)", script)
    there = {"chromium", "chromium-driver"}  # Chrome and its driver are on GitHub's machines
    (installed,) = re.findall(r"--no-install-recommends (.+)", workflow)
    assert set(installed.split()) == set(wanted.split()) - there
    jobs = yaml.safe_load(workflow)["jobs"]
    assert jobs["linux"]["steps"][-1] == {"run": "make test"}
    lowest, *_ = jobs["linux"]["strategy"]["matrix"]["python"]
    assert f'requires-python = ">={lowest}"' in (ROOT / "pyproject.toml").read_text()


def test_a_report_of_a_defect_asks_for_what_helps():
    form = (ROOT / ".github" / "ISSUE_TEMPLATE" / "bug.yml").read_text(encoding="utf-8")
    assert "tog doctor --json" in form
    assert "episode.json" in form
    for path in (ROOT / ".github" / "ISSUE_TEMPLATE").glob("*.yml"):
        assert isinstance(yaml.safe_load(path.read_text(encoding="utf-8")), dict)
