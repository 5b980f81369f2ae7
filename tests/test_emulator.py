"""The emulated robot as a process of its own, over LCM."""

import json

import pytest
from command import refused, tog
from emulator_session import SEEN
from own_network import in_own_network, needs_own_network

from tog_drake.stations.lcm_bus import RobotMode

STARVED = SEEN  # [s] whoever stands still for so long may have seen nothing of a fault


def session(name, folder):
    done = in_own_network("emulator_session.py", name, folder)
    assert done.returncode == 0, done.stderr[-3000:]
    told = json.loads(done.stdout)
    if told["gap"] > STARVED:
        pytest.skip(f"needs a computer that keeps up: this one stood for {told['gap']:.2f} s")
    assert "error" not in told, told["error"]
    return told


@pytest.fixture(scope="module")
def driven(tmp_path_factory):
    return session("driven", tmp_path_factory.mktemp("driven"))


@pytest.fixture(scope="module")
def faulty(tmp_path_factory):
    return session("faulty", tmp_path_factory.mktemp("faulty"))


@needs_own_network
def test_its_status_comes_every_period(driven):
    assert driven["ticks"] > 50  # in 2 s, of 400: on a machine that does much else
    assert driven["statuses"] > 0.3 * driven["ticks"]  # who listens is kept from it, too


@needs_own_network
def test_its_images_are_those_of_the_simulation_bit_for_bit(driven):
    images = driven["images"]
    assert images["shape"] == [480, 640, 3]
    assert images["contrast"] > 10
    assert images["rgb"]
    assert images["depth"]


@needs_own_network
def test_it_ignores_an_expired_command(driven):
    assert driven["expired"] == ["expired"]
    assert driven["mode_after_expired"] == RobotMode.MOVE


@needs_own_network
def test_it_follows_commands_and_stands_where_they_end(driven):
    assert driven["followed_to"] < 0.01


@needs_own_network
def test_its_hand_closes_ignores_the_same_command_and_opens(driven):
    assert driven["hand"]["verdicts"] == ["grasp", "ignored", "move"]
    assert driven["hand"]["moving"] == 0.005
    assert abs(driven["hand"]["closed"]) < 1e-3


@needs_own_network
def test_a_jump_is_a_reflex_after_which_it_stands_whatever_is_commanded(driven):
    assert driven["reflex"]
    assert driven["still_at"] < 0.01
    assert driven["moved_after_reflex"] < 1e-3
    assert driven["mode_at_the_end"] == RobotMode.REFLEX


@needs_own_network
@pytest.mark.parametrize("fault", ["drop", "restart"])
def test_while_the_status_is_dropped_or_the_driver_restarts_nothing_comes_and_then_it_does(
    fault, faulty
):
    assert faulty[fault]["messages"] == 0
    assert faulty[fault]["after"] == [[RobotMode.MOVE], [True]]


@needs_own_network
def test_a_status_may_come_whose_values_are_no_numbers(faulty):
    assert faulty["nan"]["numbers"] == [False]
    assert faulty["nan"]["after"] == [[RobotMode.MOVE], [True]]


@needs_own_network
def test_a_push_is_an_external_torque_of_drakes_sign_at_the_elbow(faulty):
    assert faulty["push"]["torque"] == pytest.approx(40.0, abs=5.0)
    assert abs(faulty["reflex"]["torque"]) < 5.0


@needs_own_network
def test_a_reflex_is_seen_in_the_status_until_it_is_over(faulty):
    assert faulty["reflex"]["modes"] == [RobotMode.REFLEX]
    assert faulty["reflex"]["after"][0] == [RobotMode.MOVE]


@needs_own_network
def test_lost_commands_are_on_the_wire_but_not_at_the_driver_and_late_ones_expire_there(faulty):
    assert faulty["lost"]["commands"] > 0
    assert faulty["lost"]["verdicts"] == []
    assert faulty["late"]["commands"] > 0
    assert faulty["late"]["verdicts"] == ["expired"]
    assert faulty["mode"] == RobotMode.MOVE


def test_a_fault_or_a_scenario_that_is_none_is_refused_before_anything_starts(tmp_path):
    refused(tog("hardware", "emulate", "--fault", "drop"), "KIND:CHANNEL:START:DURATION")
    refused(tog("hardware", "emulate", "--fault", "drop:TOG_SIDE:1:2"), "TOG_WRIST")
    refused(tog("hardware", "emulate", "--scenario", "Nowhere"), "unknown scenario")
    refused(tog("hardware", "emulate", "--scenario", "Mug"), "no section hardware", "panda_lcm")
    refused(tog("hardware", "emulate", "--log", tmp_path), "is a folder")
