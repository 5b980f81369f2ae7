"""Asks a person whether the arm may move: in the terminal, or by a button in Meshcat."""

import select
import sys
from collections.abc import Callable

from pydrake.geometry import Meshcat

from tog_drake.decision import Decision

MOVE_BUTTON, STAY_BUTTON = "Move", "Stay"
_GLANCE = 0.05  # [s] between two looks for an answer


def asked(
    decision: Decision, listen: Callable[[], None], *, speed: float, meshcat: Meshcat | None
) -> bool:
    """Returns whether a person said yes; whatever is not yes is no.

    Args:
        decision: what would be carried out.
        listen: called all the time, so that what comes from the robot stays fresh.
        speed: of the planned motion's.
        meshcat: where there are buttons too, if anywhere.
    """
    assert decision.choice is not None and decision.motion is not None
    held = decision.choice.part or f"grasp {decision.choice.index}"
    seconds = decision.motion.duration / speed
    where = "" if meshcat is None else f" ({meshcat.web_url()} shows it, with the same buttons)"
    sys.stderr.write(
        f"{held}: {decision.choice.reason}\n"
        f"Move the arm, {seconds:.0f} s at {speed:.0%} of the planned speed?{where} [y/N] "
    )
    sys.stderr.flush()
    if meshcat is None:
        return _answer(listen, lambda: None)
    for button in (MOVE_BUTTON, STAY_BUTTON):
        meshcat.AddButton(button)
    try:
        return _answer(listen, lambda: _clicked(meshcat))
    finally:
        for button in (MOVE_BUTTON, STAY_BUTTON):
            meshcat.DeleteButton(button)


def _clicked(meshcat: Meshcat) -> bool | None:
    if meshcat.GetButtonClicks(STAY_BUTTON) > 0:
        return False
    return True if meshcat.GetButtonClicks(MOVE_BUTTON) > 0 else None


def _answer(listen: Callable[[], None], clicked: Callable[[], bool | None]) -> bool:
    while True:
        listen()
        if (answer := clicked()) is not None:
            return answer
        if select.select([sys.stdin], [], [], _GLANCE)[0]:
            return sys.stdin.readline().strip().lower() in ("y", "yes")
