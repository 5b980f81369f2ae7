"""What is behind the emulated drivers, and the process it runs in."""

import os
import time

import numpy as np
import pytest

from tog_drake.errors import InputError
from tog_drake.hardware.arm_driver import ArmDriver, Verdict
from tog_drake.hardware.emulated_world import Child, Drive, EmulatedWorld
from tog_drake.scenario import LOOK_POSTURE, load_scenario
from tog_drake.stations.lcm_bus import arm_command_message

PERIOD = 0.005  # [s]


def test_the_arm_follows_what_its_driver_makes_of_unevenly_stamped_commands():
    world, driver = EmulatedWorld(load_scenario("panda_lcm")), ArmDriver(np.array(LOOK_POSTURE))
    rng = np.random.default_rng(0)
    now, state = 1e9, world(None)
    np.testing.assert_allclose(state.q, LOOK_POSTURE)
    for i in range(200):
        now += PERIOD
        q = np.array(LOOK_POSTURE)
        q[0] += 0.25 * (1 - np.cos(np.pi * i / 200))  # at most 0.8 rad/s
        stamp = now - rng.uniform(0.0, 0.004)  # [s] so unevenly does a busy computer send
        assert driver.receive(arm_command_message(q, round(1e6 * stamp)), now) is Verdict.ACCEPTED
        state = world(Drive(driver.advance(now, PERIOD), opening=0.08, dt=PERIOD))
        np.testing.assert_allclose(state.q, q, atol=0.015)
    for _ in range(40):
        now += PERIOD
        state = world(Drive(driver.advance(now, PERIOD), opening=0.04, dt=PERIOD))
    np.testing.assert_allclose(state.q, q, atol=1e-3)
    assert state.opening == pytest.approx(0.04, abs=1e-3)
    assert np.abs(state.torque_external).max() < 0.1  # it touches nothing


def slowly(gate):
    def answer(asked):
        while not gate.exists():
            time.sleep(0.01)
        return asked + 1

    return answer


def test_who_asks_a_slow_process_does_not_wait_for_its_answer(tmp_path):
    child = Child(slowly, tmp_path / "open", nice=0)
    try:
        child.wait()
        child.ask(1)
        assert child.busy
        assert child.answer() is None
        (tmp_path / "open").touch()
        assert child.wait() == 2
        assert not child.busy
    finally:
        child.end()


def refusing():
    raise InputError("it cannot be made")


def dying():
    return lambda status: os._exit(status)


def test_a_process_that_cannot_do_its_work_says_so_and_one_that_dies_is_noticed():
    refused = Child(refusing, nice=0)
    with pytest.raises(InputError, match="cannot be made"):
        refused.wait()
    refused.end()
    dead = Child(dying, nice=0)
    dead.wait()
    dead.ask(7)
    with pytest.raises(RuntimeError, match="died, status 7"):
        dead.wait()
    dead.end()
