"""``tog hardware run`` from end to end: two processes over LCM, and what goes over the wire."""

import json
import os
from dataclasses import replace
from pathlib import Path
from unittest import mock

import numpy as np
import pytest
from command import refused, tog
from hardware_session import GRIP_FORCE, PATIENT, REFUSED, SEED, TASK
from own_network import in_own_network, needs_own_network
from pydrake.common.value import Value
from pydrake.systems.analysis import Simulator

from tog_drake.decision import Decision, decide
from tog_drake.executor import ExecutorState, Phase
from tog_drake.hardware.asking import asked
from tog_drake.hardware.episode import judge
from tog_drake.panda import MAX_OPENING
from tog_drake.record import new_record
from tog_drake.recording import load_recording
from tog_drake.replay import set_stage
from tog_drake.safety import PERIOD, Commanded, SafetyConfig, StopReason
from tog_drake.scenario import load_scenario
from tog_drake.stations.guard import GuardMode, GuardState
from tog_drake.stations.panda_lcm import UNCHANGED, HandCommand, due
from tog_drake.values import Choice, GraspMotion
from tog_drake.world import build_world, look


def session(name, folder):
    done = in_own_network("hardware_session.py", name, folder, timeout=900)
    assert done.returncode == 0, done.stderr[-3000:]
    return json.loads(done.stdout.splitlines()[-1])


@pytest.fixture(scope="module")
def lifted(tmp_path_factory):
    told = session("lifted", tmp_path_factory.mktemp("lifted"))
    record = told["run"]["record"]
    if record is not None and record["hardware"]["rule"] in ("stalled", "stale_status", "deadline"):
        pytest.skip(f"needs a computer that keeps up: {record['message']}")
    assert told["run"]["status"] == 0, told["run"]
    return told


@pytest.fixture(scope="module")
def simulated():
    scenario = load_scenario("panda_lcm", PATIENT, seed=SEED)
    world = build_world(scenario, target=None, task=TASK, meshcat=None)
    simulator = look(world, scenario, TASK)
    decision = decide(world.pipeline, simulator.get_context())
    return new_record(decision, scenario.pipeline, task=TASK, seed=SEED)


@needs_own_network
def test_a_dry_run_decides_and_sends_not_one_message(lifted):
    assert lifted["dry"]["status"] == 0, lifted["dry"]
    assert lifted["dry"]["record"]["outcome"] == "chosen"
    assert lifted["dry_sent"] == 0


@needs_own_network
def test_the_program_in_diagrams_asks_before_it_moves(lifted):
    assert lifted["program"]["status"] == 0, lifted["program"]
    assert "Move the arm? [y/N]" in lifted["program"]["out"]
    assert lifted["program_sent"] == 0


@needs_own_network
def test_the_real_robot_lifts_the_hammer(lifted):
    run = lifted["run"]
    assert run["status"] == 0, run
    record = run["record"]
    assert (record["outcome"], record["grasp_success"]) == ("lifted", True)
    hardware = record["hardware"]
    assert (hardware["speed"], hardware["rule"], hardware["force"]) == (0.5, None, None)
    assert hardware["opening_after"] == pytest.approx(record["choice"]["width"], abs=0.005)
    assert record["task_compliance"] is None  # nobody knows the truth here
    assert lifted["files"] == ["episode.json", "recording.npz", "report.html"]


@needs_own_network
def test_an_episode_on_a_robot_can_be_replayed_with_what_it_knew_of_its_world(lifted):
    recording = load_recording(Path(lifted["folder"]))
    stage = set_stage(recording)
    assert stage.positions.shape[1] == 9  # arm and fingers: where the hammer was is not known
    assert np.abs(stage.positions[-1, :7] - stage.positions[0, :7]).max() > 0.1
    width = 2 * stage.positions[:, 7]
    after = lifted["run"]["record"]["hardware"]["opening_after"]
    assert width[0] > 0.07 and width[-1] == pytest.approx(after, abs=0.005)
    assert len(recording.sketch.cloud) > 100 and len(recording.sketch.choice) == 4


@needs_own_network
def test_no_command_is_a_jump_and_the_first_is_where_the_arm_is(lifted):
    told = lifted["commanded"]
    assert told["first"] <= SafetyConfig().start_tolerance
    assert told["fastest"] <= SafetyConfig().velocity
    assert told["discontinuity"] <= 0.5
    assert told["refused"] == []
    assert lifted["hand"] == [["grasp", GRIP_FORCE]]  # it was open already, and is told to close


@needs_own_network
def test_the_real_robot_decides_as_the_simulated_one(lifted, simulated):
    real = lifted["run"]["record"]
    closing = simulated["motion"]["phases"]["lift"] - simulated["motion"]["phases"]["close"]
    assert closing == pytest.approx(1.1)  # from 8 cm apart at 1 m/s, and one second
    assert real["choice"]["part"] == simulated["choice"]["part"]
    assert real["choice"]["width"] == pytest.approx(simulated["choice"]["width"], abs=1e-3)
    assert real["choice"]["pixel"] == pytest.approx(simulated["choice"]["pixel"], abs=3)
    assert real["motion"]["duration"] == pytest.approx(simulated["motion"]["duration"], rel=0.02)
    assert real["motion"]["phases"] == pytest.approx(simulated["motion"]["phases"], rel=0.02)


@pytest.fixture(scope="module")
def ruled(tmp_path_factory):
    return session("ruled", tmp_path_factory.mktemp("ruled"))


@needs_own_network
@pytest.mark.parametrize("rule", REFUSED)
def test_a_motion_that_would_break_a_rule_is_not_begun(rule, ruled):
    assert ruled[rule] == {"outcome": "stopped", "rule": rule, "sent": 0}


@needs_own_network
def test_a_motion_that_does_not_begin_where_the_arm_is_by_now_is_not_begun(ruled):
    assert ruled["start"] == {"outcome": "stopped", "rule": "start", "sent": 0}


@needs_own_network
def test_without_fresh_images_nothing_is_decided(ruled):
    assert ruled["no_image"] == {"outcome": "no_image", "rule": None, "sent": 0}


@needs_own_network
def test_an_arm_that_somebody_else_commands_is_left_alone(ruled):
    assert ruled["foreign_command"] == {"outcome": "stopped", "rule": "foreign_command"}


@needs_own_network
@pytest.mark.parametrize(
    ("event", "rule"),
    [
        *[(rule, rule) for rule in ("external_torque", "tracking", "stalled", "operator")],
        *[(rule, rule) for rule in ("deadline", "stale_status", "robot_mode")],
        ("terminated", "operator"),
    ],
)
def test_what_breaks_a_rule_on_the_way_stops_the_arm_which_then_stands_still(event, rule, ruled):
    assert (ruled[event]["outcome"], ruled[event]["rule"]) == ("stopped", rule)
    moved, commands = ruled[event]["still"]
    assert moved < 0.002
    assert commands == 0


@needs_own_network
def test_ctrl_c_stops_the_arm_which_then_stands_still(ruled):
    told = ruled["interrupted"]
    assert told["status"] == 1, told
    assert told["record"]["outcome"] == "stopped"
    assert told["record"]["hardware"]["rule"] == "operator"
    assert "SIGINT" in told["record"]["message"]
    assert told["commanded"]["refused"] == []
    moved, commands = told["still"]
    assert moved < 0.002
    assert commands == 0


@pytest.mark.parametrize(
    ("said", "meant"), [("y\n", True), ("Yes\n", True), ("n\n", False), ("\n", False), ("", False)]
)
def test_whatever_is_not_yes_is_no(said, meant, monkeypatch, capsys):
    reader, writer = os.pipe()
    os.write(writer, said.encode())
    os.close(writer)
    chosen = replace(Choice.none(), part="head", reason="it is the head")
    motion = replace(GraspMotion.still(), duration=8.0)
    listened = []
    with os.fdopen(reader) as stdin:
        monkeypatch.setattr("sys.stdin", stdin)
        decision = Decision(choice=chosen, motion=motion)
        answer = asked(decision, lambda: listened.append(1), speed=0.25, meshcat=None)
    assert answer is meant
    assert listened
    assert "32 s at 25%" in capsys.readouterr().err


def test_what_no_real_robot_can_do_is_refused_before_it_is_connected_to(tmp_path):
    def run(text, *options):
        return tog(
            *("hardware", "run", "--task", "hand me the hammer", "--out", tmp_path),
            *("--no-meshcat", "--scenario-text", text, *options),
        )

    refused(run("{pipeline: {retries: 1}}"), "moves once")
    refused(run("{hardware: {safety: {velocity: 2}}}"), "velocity", "0 to 1")
    refused(run("{pipeline: {opens_fully: false}}"), "arrives fully open")
    refused(run("{hardware: null}"), "no section hardware", "panda_lcm")


def judged(closed, after, phase=Phase.DONE, broken=None, opened=0.08):
    state = ExecutorState(phase=phase, opening_after=after)
    guarded = GuardState(GuardMode.STOPPED if broken else GuardMode.ARMED, broken=broken)
    return judge(guarded, state, (opened, closed), 0.002)[0]


def test_success_is_told_by_the_width_of_the_hand():
    assert judged(0.012, 0.0119) == "lifted"
    assert judged(0.012, 0.0001) == "dropped"
    assert judged(0.012, 0.0085) == "dropped"
    assert judged(0.0005, 0.0005) == "empty"
    assert judged(0.0795, 0.0795) == "empty"  # it was told to close and did not
    assert judged(0.0400, 0.0400, opened=0.0405) == "empty"  # nor here, where it is stuck
    assert judged(None, None, Phase.FAILED) == "collision"
    assert judged(0.012, 0.012, broken=(StopReason.TRACKING, "it strayed")) == "stopped"


@pytest.mark.parametrize("last", [0.002, 1.5e-4, 5e-5, 1e-12])
def test_wherever_the_ramp_ends_before_it_presses_the_hand_is_told_to_close(last):
    bus = mock.Mock()
    bus.hand.newest.opening = MAX_OPENING
    hand = HandCommand(bus, 40.0)
    simulator = Simulator(hand)
    for tick, opening in enumerate([0.06] * 40 + [0.03, last] + [-0.02] * 40):
        guarded = GuardState(GuardMode.ARMED, Commanded.at_rest(np.zeros(7)), opening)
        hand.get_input_port().FixValue(simulator.get_mutable_context(), Value(guarded))
        simulator.AdvanceTo((tick + 1) * PERIOD)
    assert {call.args for call in bus.command_hand.call_args_list} == {(0.0, 40.0)}


def test_the_hand_is_told_an_opening_that_stays_and_never_a_narrower_one_but_to_grasp():
    nothing = np.nan
    assert not due(0.08, 1.0, nothing, 1.0 + UNCHANGED / 2)
    assert due(0.08, 1.0, nothing, 1.0 + UNCHANGED)
    assert not due(0.06, 1.0, 0.08, 2.0)  # the driver would grasp, whatever the width
    assert due(0.0, 1.0, 0.08, 2.0)
    assert not due(0.0, 1.0, 0.0, 2.0)
    assert due(0.08, 1.0, 0.0, 2.0)
    assert not due(nothing, 0.0, nothing, 2.0)
