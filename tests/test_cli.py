"""The command as a user meets it: what it prints, where, and with which status it ends."""

import errno
import json
import os
import re
import signal
import subprocess
import sys
import time
from typing import get_type_hints

import pytest
import yaml
from command import COMMANDS, checked, refused, tog

from tog_drake.benchmark.cells import scenario_of
from tog_drake.record import OUTCOMES, SCHEMA, EpisodeRecord
from tog_drake.resources import resource_dir
from tog_drake.scenario import load_scenario
from tog_drake.world import build_world

SCENARIOS = [
    *("Axe", "Bottle", "Brush", "Cup", "Hammer", "Knife", "LotionBottle", "Muddler", "Mug"),
    *("Pan", "Pot", "Scissors", "Screwdriver", "Spatula", "Spoon", "ToyDinosaur"),
    *("ToyElephant", "Umbrella", "Whisk"),
]
OBJECTS = [name.lower() for name in SCENARIOS]
STAGES = [
    "render", "cloud", "propose", "filter", "candidates", "choose_view", "select", "plan"
]  # fmt: skip


def _hammer_at(x, name="hammer"):
    """A directive that puts a hammer on the table."""
    return {
        "add_model": {
            "name": name,
            "file": "package://tog_drake/objects/hammer/hammer.sdf",
            "default_free_body_pose": {"base": {"translation": [x, 0.0, 0.001]}},
        }
    }


def _write_scenario(path, *directives):
    table = {"add_directives": {"file": "package://tog_drake/scenes/table.dmd.yaml"}}
    path.write_text(yaml.safe_dump({"directives": [table, *directives]}), encoding="utf-8")
    return path


@pytest.fixture
def out_of_view(tmp_path):
    """A scenario whose only object lies behind the robot, where the camera does not look."""
    return _write_scenario(tmp_path / "behind.yaml", _hammer_at(-0.5))


def _start(*arguments, cwd):
    """Starts ``tog`` as a process of its own."""
    return subprocess.Popen(
        [sys.executable, "-m", "tog_drake.cli", *map(str, arguments)],
        cwd=cwd,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


# --- help ---------------------------------------------------------------------------------------


def test_help_lists_every_subcommand():
    done = tog("--help")
    assert (done.status, done.err) == (0, "")
    for name in (
        "run", "demo", "choose", "eval", "scenarios", "show", "diagram", "doctor", "prompts", "vlm"
    ):  # fmt: skip
        assert f"\n  {name} " in done.out


@pytest.mark.parametrize("name", COMMANDS)
def test_every_subcommand_has_help_with_an_example_that_can_be_typed(name):
    words = name.split()
    done = tog(*words, "--help")
    assert done.status == 0
    example = " ".join(done.out.split("Example: ")[1].split())
    assert checked(example) == name


def test_alone_it_shows_the_stages_in_order_and_commands_to_begin_with():
    done = tog()
    assert (done.status, done.err) == (0, "")
    assert done.out.isascii()
    assert max(map(len, done.out.splitlines())) <= 80
    loaded = load_scenario("Hammer")
    diagram = build_world(loaded, target="hammer").diagram.GetSubsystemByName("pipeline")
    stages = [system.get_name() for system in diagram.GetSystems()]
    shown = re.findall(r"^  (?:->|  ) (\w+)", done.out, re.M)
    assert shown == stages
    commands = re.findall(r"^  (tog .+?)  ", done.out, re.M)
    assert len(commands) == 5
    for command in commands:
        checked(command)


@pytest.mark.parametrize("arguments", [("run",), ("choose",), ("eval",), ("diagram",), ("show",)])
def test_without_what_is_needed_the_usage_is_shown(arguments):
    done = tog(*arguments)
    assert done.status == 2
    assert "Usage: tog" in done.out + done.err


@pytest.mark.parametrize(
    ("words", "offered"),
    [("tog ru", {"run"}), ("tog show Mu", {"Muddler", "Mug", "MugHandleHidden"})],
)
def test_a_shell_completes_commands_and_scenarios(words, offered, monkeypatch):
    monkeypatch.setenv("_TOG_COMPLETE", "complete_bash")
    monkeypatch.setenv("COMP_WORDS", words)
    monkeypatch.setenv("COMP_CWORD", str(len(words.split()) - 1))
    done = tog()
    assert (done.status, done.err) == (0, "")
    assert set(done.out.split()) == offered


@pytest.mark.parametrize(
    ("shell", "line"),
    [
        ("bash", "complete -o default -F _tog_completion tog"),
        ("zsh", "compdef _tog_completion tog"),
    ],
)
def test_the_completion_of_a_shell_is_shown(shell, line, monkeypatch):
    monkeypatch.setattr("typer.completion._get_shell_name", lambda: shell)
    done = tog("--show-completion")
    assert (done.status, done.err) == (0, "")
    assert line in done.out.splitlines()


# --- bad input ----------------------------------------------------------------------------------

RUN = ("run", "--no-meshcat", "--task", "use the hammer")
BAD = {
    "scenario": ((*RUN, "--scenario", "Hamer"), ["'Hamer'", *SCENARIOS, "YAML file"]),
    "folder as scenario": ((*RUN, "--scenario", "."), ["'.'", *SCENARIOS]),
    "object": ((*RUN, "--object", "anvil"), ["'anvil'", *OBJECTS]),
    "object of a scenario": (
        (*RUN, "--scenario", "Hammer", "--object", "mug"),
        ["'mug'", "valid: hammer"],
    ),
    "selector": (
        (*RUN, "--selector", "best"),
        ["'best'", "geometric", "top-score", "random", "oracle"],
    ),
    "proposer": ((*RUN, "--proposer", "gpd"), ["'gpd'", "antipodal"]),
    "field": ((*RUN, "--scenario-text", "sede: 3"), ["'sede'", "random_seed", "pipeline"]),
    "nested field": (
        (*RUN, "--scenario-text", "pipeline: {clod: {}}"),
        ["'clod'", "did you mean cloud?", "executor"],
    ),
    "tag": (
        (*RUN, "--scenario-text", "pipeline: {selector: !Best {}}"),
        ["!Best", "!Geometric", "!TopScore", "!Random", "!Oracle"],
    ),
    "value": ((*RUN, "--scenario-text", "random_seed: many"), ["random_seed", "'many'"]),
    "no YAML": ((*RUN, "--scenario-text", "a: ["), ["--scenario-text", "not valid YAML"]),
    "camera": ((*RUN, "--scenario-text", "pipeline: {camera: left}"), ["'left'", "wrist"]),
    "resolution": (
        (*RUN, "--scenario-text", "cameras: {wrist: !L515 {resolution: 8x8}}"),
        ["'8x8'", "640x480", "1280x720"],
    ),
    "no object": ((*RUN, "--scenario-text", "directives: []"), ["holds no object", "add_model"]),
    "empty task": (("run", "--task", ""), ["no words", "hand me the hammer"]),
    "blank task": (("run", "--task", "  "), ["no words"]),
    "task without a word": (("run", "--task", "?!"), ["'?!'", "no words"]),
    "K = 0": ((*RUN, "--k", "0"), ["K is '0'", "at least 1", "auto"]),
    "K = -1": ((*RUN, "--k", "-1"), ["K is '-1'", "at least 1", "auto"]),
    "K = foo": ((*RUN, "--k", "foo"), ["K is 'foo'", "at least 1", "auto"]),
    "show": (("show", "Hamer"), ["'Hamer'", *SCENARIOS]),
    "diagram": (("diagram", "Hamer", "--out", "x.svg"), ["'Hamer'", *SCENARIOS]),
    "eval's selector": (("eval", "Mug", "--selectors", "oracle,best"), ["'best'", "top-score"]),
    "eval's suite": (("eval", "Hamer"), ["'Hamer'", "builtin", "tog29", *SCENARIOS]),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input_is_one_line_with_what_was_given_and_what_is_valid(case, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    arguments, words = BAD[case]
    refused(tog(*arguments), *words)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("text", "word"),
    [
        ("initial_position: {panda: {elbow: 1}}", "panda_joint4"),
        ("directives: [{add_model: {name: a, file: package://tog_drake/a.sdf}}]", "a.sdf"),
        ("directives: [{add_model: {name: a, file: package://b/a.sdf}}]", "'b'"),
        ("plant_config: {contact_model: soft}", "'soft'"),
        ("plant_config: {time_step: -1}", "time_step"),  # Drake gives up with SystemExit
    ],
)
def test_what_drake_refuses_of_a_scenario_is_bad_input_too(text, word, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    refused(tog(*RUN, "--scenario-text", text), word)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("run",), ["Missing option '--task'"]),
        (("run", "--task", "x", "--seed", "-1"), ["'--seed'", "0"]),
        (("run", "--task", "x", "--seed", "1.5"), ["'--seed'", "integer"]),
        (("run", "--task", "x", "--sed", "1"), ["--sed", "--seed"]),
        (("eval", "Mug", "--seeds", "0"), ["'--seeds'", "1"]),
        (("demo", "--seed", "-1"), ["'--seed'", "0"]),
        (("frobnicate",), ["'frobnicate'"]),
    ],
)
def test_misused_options_are_named_and_lead_to_the_help(arguments, words):
    done = tog(*arguments)
    assert (done.status, done.out) == (2, "")
    assert "Traceback" not in done.err
    assert "--help" in done.err
    for word in words:
        assert word in done.err


def test_a_traceback_is_shown_only_when_it_is_asked_for():
    done = tog("--debug", *RUN, "--scenario", "Hamer")
    assert done.status == 2
    assert "Traceback" in done.err
    assert "InputError" in done.err
    assert done.err.splitlines()[-1].startswith("tog: unknown scenario 'Hamer'")


def test_what_the_system_refuses_names_the_file_and_a_way_out(monkeypatch):
    def full():
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "out/episode.json")

    monkeypatch.setattr("tog_drake.resources.scenario_files", full)
    done = tog("scenarios")
    refused(done, "out/episode.json: No space left on device", "name another", "make room")


def test_a_defect_of_the_program_has_a_status_of_its_own_and_no_traceback(monkeypatch):
    monkeypatch.setattr("tog_drake.resources.scenario_files", lambda: {}["lost"])
    done = tog("scenarios")
    assert (done.status, done.out) == (3, "")
    assert done.err == "tog: internal error, KeyError: 'lost' (--debug shows where)\n"
    assert "Traceback" in tog("scenarios", "--debug").err


@pytest.mark.parametrize(
    "arguments",
    [
        (*RUN, "--out", "taken"),
        (*RUN, "--out", "taken/below"),
        ("demo", "--out", "taken"),
        ("eval", "Mug", "--out", "taken"),
        ("show", "Hammer", "--out", "taken/scene.html"),
        ("diagram", "Hammer", "--out", "taken/hammer.svg"),
    ],
)
def test_a_file_in_the_way_of_the_output_is_said_before_the_work(arguments, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "taken").write_text("mine", encoding="utf-8")
    refused(tog(*arguments), "--out taken", "taken is a file")
    assert (tmp_path / "taken").read_text(encoding="utf-8") == "mine"
    assert [path.name for path in tmp_path.iterdir()] == ["taken"]


@pytest.mark.parametrize(
    "command", [("show", "Hammer"), ("show", "objects"), ("diagram", "Hammer")]
)
def test_a_folder_or_a_device_where_a_file_is_to_be_written_is_said(command, tmp_path):
    refused(tog(*command, "--out", tmp_path), f"{tmp_path} is a folder")
    os.mkfifo(tmp_path / "pipe")  # as little a file as /dev/stdout, which root could replace
    refused(tog(*command, "--out", tmp_path / "pipe"), "no ordinary file")


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_a_folder_without_permission_is_said(tmp_path):
    tmp_path.chmod(0o500)
    refused(tog(*RUN, "--out", tmp_path / "a" / "b"), "may not be written to")


# --- run ----------------------------------------------------------------------------------------


def test_a_hammer_is_handed_over_and_recorded_field_by_field(tmp_path):
    """The one full episode of this file; as a process, so that nobody else's output is missed."""
    arguments = ("--seed", 0, "--task", "hand me the hammer", "--no-meshcat", "--out", "r")
    run = _start("run", "--json", *arguments, cwd=tmp_path)
    out, err = run.communicate(timeout=300)
    assert run.returncode == 0, err
    (line,) = out.splitlines()  # nothing else on stdout
    record = json.loads(line, parse_constant=pytest.fail)
    for word in ("Traceback", "INFO", "live:"):
        assert word not in err
    assert [word for word in (*STAGES, "decide", "execute") if f" {word} " not in err] == []
    assert "outcome: lifted" in err
    assert {str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*")} == {
        "r", "r/episode.json", "r/recording.npz", "r/report.html"
    }  # fmt: skip
    assert json.loads((tmp_path / "r/episode.json").read_text(encoding="utf-8")) == record
    _check_lifted(record)


def _check_lifted(record):
    assert list(record) == list(get_type_hints(EpisodeRecord))
    assert record["schema"] == SCHEMA
    assert record["task"] == "hand me the hammer"
    assert (record["object"], record["scenario"], record["seed"]) == ("hammer", "Hammer", 0)
    assert record["selector"]["kind"] == "geometric"
    assert record["proposer"]["kind"] == "antipodal"
    counts, rejected = record["counts"], record["rejected"]
    assert set(counts) == {"points", "proposed", "feasible", "candidates"}
    assert {"no_ik", "hand_collision", "arm_collision"} <= set(rejected)
    assert counts["proposed"] == counts["feasible"] + sum(rejected.values())
    assert counts["points"] > 100
    assert 1 <= counts["candidates"] <= counts["feasible"]
    choice = record["choice"]
    assert set(choice) >= {"index", "part", "reason", "status", "pixel"}
    assert 0 <= choice["index"] < counts["feasible"]
    assert (choice["part"], choice["status"]) == ("head", "ok")
    assert 0 <= choice["pixel"][0] < 640
    assert 0 <= choice["pixel"][1] < 480
    assert (record["outcome"], record["message"]) == ("lifted", None)
    assert record["grasp_success"] is record["task_compliance"] is True
    assert record["combined_success"] is True
    assert record["allowed"] == ["head"]
    assert record["held"]["head"] >= 0.8
    assert sum(record["held"].values()) == pytest.approx(1.0)
    assert record["lift"] >= 0.10
    seconds = record["seconds"]
    assert list(seconds) == [*STAGES, "decide", "execute"]
    assert all(value > 0 for value in seconds.values())
    assert seconds["decide"] == pytest.approx(sum(seconds[stage] for stage in STAGES[1:]))
    phases = record["motion"]["phases"]
    assert phases["approach"] < phases["close"] < phases["lift"] < phases["hold"]
    assert record["motion"]["duration"] >= phases["hold"] + 2.0
    assert record["sim"]["seconds"] == pytest.approx(1.0 + record["motion"]["duration"], abs=0.1)
    assert record["sim"]["real_time_rate"] == pytest.approx(
        (record["sim"]["seconds"] - 1.0) / seconds["execute"], rel=0.01
    )


def test_with_nothing_in_view_it_ends_in_status_1_with_the_outcome(out_of_view, tmp_path):
    done = tog(
        "run", "--scenario", out_of_view, "--task", "use [/x] the :hammer:", "--no-meshcat",
        "--json", "--out", tmp_path / "r",
    )  # fmt: skip
    assert done.status == 1
    record = json.loads(done.out)
    assert record["task"] == "use [/x] the :hammer:"
    assert record["task"] in done.err  # no markup, no emoji
    assert record["outcome"] == "no_grasp"
    assert record["outcome"] in OUTCOMES
    assert "no object in view" in record["message"]
    assert record["scenario"] == str(out_of_view)
    assert record["choice"] is None
    assert record["grasp_success"] is False
    assert "outcome: no_grasp (no object in view" in done.err
    assert json.loads((tmp_path / "r/episode.json").read_text(encoding="utf-8")) == record
    assert "no_grasp" in (tmp_path / "r/report.html").read_text(encoding="utf-8")


def test_with_two_objects_it_asks_which_one_is_meant(tmp_path):
    two = _write_scenario(tmp_path / "two.yaml", _hammer_at(0.5, "left"), _hammer_at(0.7, "right"))
    refused(tog(*RUN, "--scenario", two), "--object", "left", "right")


@pytest.mark.parametrize("name", ["toy_dinosaur", "Toy Dinosaur", "ToyDinosaur"])
def test_an_object_may_be_spelled_as_people_do(name):
    assert scenario_of(name) == "ToyDinosaur"


@pytest.mark.parametrize("wait", [0.0, 3.0], ids=["while it is built", "while it runs"])
def test_ctrl_c_ends_a_run_at_once_and_leaves_no_file(wait, tmp_path):
    long = "{pipeline: {trajectory: {hold_time: 300.0}}}"  # on any computer
    words = ("--task", "use the hammer", "--scenario-text", long, "--out", "r")
    run = _start("run", *words, cwd=tmp_path)
    assert run.stdout.readline().startswith("live: http://localhost:")
    time.sleep(wait)
    run.send_signal(signal.SIGINT)
    _, err = run.communicate(timeout=60)
    assert run.returncode == 130
    assert err == "interrupted\n"
    assert list(tmp_path.iterdir()) == []


def test_ctrl_c_while_a_file_is_written_leaves_the_earlier_one_whole(tmp_path, monkeypatch):
    page = tmp_path / "scene.html"
    page.write_text("before", encoding="utf-8")
    monkeypatch.setattr(os, "fsync", lambda file: os.kill(os.getpid(), signal.SIGINT))
    done = tog("show", "Hammer", "--out", page)
    assert (done.status, done.err) == (130, "interrupted\n")
    assert [path.name for path in tmp_path.iterdir()] == ["scene.html"]
    assert page.read_text(encoding="utf-8") == "before"


# --- the other subcommands ----------------------------------------------------------------------


def test_scenarios_are_listed_for_people_or_as_json():
    done = tog("scenarios")
    assert (done.status, done.err) == (0, "")
    assert all(name in done.out for name in SCENARIOS)
    done = tog("scenarios", "--json")
    listed = json.loads(done.out)
    assert set(listed) >= set(SCENARIOS)
    assert all(listed.values()), "every scenario begins with a comment that says what it is"
    assert "Hammer" in done.err


def test_every_scenario_file_is_listed():
    files = {path.stem for path in resource_dir("diagrams").glob("*.yaml")}
    assert set(json.loads(tog("scenarios", "--json").out)) == files


def test_show_serves_the_scene_on_this_machine_until_ctrl_c(tmp_path):
    show = _start("show", "Hammer", cwd=tmp_path)
    assert show.stdout.readline().startswith("live: http://localhost:")
    show.send_signal(signal.SIGINT)
    _, err = show.communicate(timeout=60)
    assert (show.returncode, err) == (130, "interrupted\n")
    assert list(tmp_path.iterdir()) == []


def test_a_diagram_needs_no_key_of_the_model_in_it(monkeypatch, tmp_path):
    for variable in ("GOOGLE_API_KEY", "GEMINI_API_KEY"):
        monkeypatch.delenv(variable, raising=False)
    text = "pipeline: {selector: !Vlm {model: !Gemini {model: gemini-3.8-flash}}}"
    done = tog("diagram", "Hammer", "--scenario-text", text, "--out", tmp_path / "a.svg")
    assert done.status == 0, done
    done = tog("diagram", "Hammer", "--vlm", "gemini:gemini-3.8-flash", "--out", tmp_path / "b.svg")
    assert done.status == 0, done


def test_diagram_writes_a_picture(tmp_path):
    done = tog("diagram", "Hammer", "--selector", "oracle", "--out", tmp_path / "a" / "h.svg")
    assert (done.status, done.err) == (0, "")
    assert done.out == f"picture: {tmp_path / 'a' / 'h.svg'}\n"  # never broken in two
    assert "OracleSelector" in (tmp_path / "a" / "h.svg").read_text(encoding="utf-8")


def test_doctor_prints_one_json_object():
    done = tog("doctor", "--json")
    assert done.status == 0, done.err
    checks = json.loads(done.out)
    assert checks["Drake"]["ok"]
    assert set(checks["Drake"]) == {"name", "ok", "found", "required"}


# --- noise --------------------------------------------------------------------------------------


def test_noise_is_refused_for_a_camera_whose_noise_nobody_knows(tmp_path):
    text = "cameras: {wrist: !CameraConfig {}}"
    done = tog(
        "run", "--task", "use the hammer", "--noise", "--scenario-text", text, "--out", tmp_path
    )
    refused(done, "camera wrist", "!L515 {}", "!D435 {}")


@pytest.mark.parametrize(
    ("words", "valid"),
    [
        (("show", "Mug", "--out"), ".html"),
        (("show", "objects", "--out"), ".png"),
        (("diagram", "Mug", "--out"), ".svg"),
        (("hardware", "board", "--out"), ".png"),
        (("replay", "nowhere", "--html"), ".html"),
        (("replay", "nowhere", "--video"), ".mp4"),
        (("assets", "show", "nothing", "--out"), ".png or .html"),
        (("assets", "label", "nothing", "--out"), ".png or .html"),
    ],
)
def test_a_name_that_would_not_open_as_what_is_written_is_refused(words, valid, tmp_path):
    file = tmp_path / "out.txt"
    refused(tog(*words, file), f"must end in {valid}, not {file}")
    assert not file.exists()


def test_a_file_in_the_place_of_a_run_is_named_by_its_place(tmp_path):
    (tmp_path / "page.html").write_text("")
    refused(tog("report", tmp_path / "page.html"), "DIR", "is a file")
