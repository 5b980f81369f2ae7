"""Going through an episode by hand: buttons and sliders in Meshcat, one for each step.

The pipeline is the same, and so are judge and record. Only who says when the next stage is asked,
and sometimes which grasp it is to be, is a person: then the record says so, and what the selector
had said.
"""

import threading
import time
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from pydrake.geometry import Meshcat
from pydrake.systems.framework import Context

from tog_drake.billboard import board_image, set_billboard
from tog_drake.decision import Decision, go_on
from tog_drake.drawing import Image, candidate_color_name, decision_image
from tog_drake.episode import Episode, draw, run_episode
from tog_drake.errors import InputError, Stopped
from tog_drake.pipeline import SelectorConfig
from tog_drake.record import kind_and_settings
from tog_drake.report import write_report
from tog_drake.safety import StopReason
from tog_drake.scenario import Scenario
from tog_drake.selector import choose
from tog_drake.selectors.strategies import PERMUTABLE, STRATEGIES
from tog_drake.selectors.vlm.selector import Vlm
from tog_drake.showing import report_of, save_episode
from tog_drake.values import Choice
from tog_drake.visualization import EYE
from tog_drake.vlm_record import exchanges_of
from tog_drake.world import World

LOOK, PROPOSE, ASK = "1 Look", "2 Propose grasps", "3 Ask the selector"
NEXT, APPROVE, RUN = "Next candidate, by hand", "4 Approve: plan the motion", "5 Run"
STOP, RESET, END = "STOP", "Reset with a new seed", "End"
STEPS = (LOOK, PROPOSE, ASK, NEXT, APPROVE, RUN, RESET, END)
K_SLIDER = "K (0: auto)"
BOARD = "/panel/board"
_BOARD_AT = np.array([-0.8, -0.22, 0.42])  # [m] in W
_GLANCE = 0.05  # [s] between two looks for a click


class _AgainError(Exception):
    """The world is to be built anew: another seed, K or strategy."""


class _OverError(Exception):
    """The person has ended it."""


class ControlPanel:
    """The panel of one scenario. It is an ``Attendant``: ``run_episode`` asks it.

    Args:
        meshcat: where its buttons are, and everything is drawn.
        scenario: changed in place by the panel: its seed, K and strategy.
        name: of the scenario, for the record.
        task: what a person said.
        target: as in ``build_world``.
        out: the folder for ``episode.json`` and ``report.html`` of the last run.
    """

    def __init__(
        self,
        meshcat: Meshcat,
        scenario: Scenario,
        *,
        name: str,
        task: str,
        target: str | None = None,
        out: Path,
    ):
        self.meshcat = meshcat
        self.scenario = scenario
        self.decision = Decision()
        self.status = ""
        self._name, self._task, self._target, self._out = name, task, target, out
        self._clicked: dict[str, int] = {}
        self._picks: list[str] = []  # the buttons of the candidates
        self._presses: Iterator[str] | None = None
        self._resume: str | None = None  # the stage to go on to at once, in a world built anew
        self._running = False
        self._over = threading.Event()
        self._strategies = _strategies(scenario.pipeline.selector)

    def run(self, presses: Iterable[str] | None = None) -> Episode | None:
        """Goes through episodes until the person ends it; returns the last that was run.

        Args:
            presses: the buttons, by name, that are pressed one after another, and then it ends:
                for a program in a person's place. None: those of Meshcat are waited for.
        """
        self._presses = None if presses is None else iter(presses)
        self._add_controls()
        last = None
        try:
            while True:
                try:
                    last = self._episode()
                    self._wait_for(RESET, LOOK)
                except _AgainError:
                    continue
        except (_OverError, KeyboardInterrupt):
            return last
        finally:
            self.meshcat.DeleteAddedControls()

    def end(self) -> None:
        """Ends ``run`` from another thread, where it waits for a person."""
        self._over.set()

    def _episode(self) -> Episode:
        self._tell(f"1 Look: {self._task!r} in {self._name}, seed {self.scenario.random_seed}")
        episode = run_episode(
            self.scenario,
            name=self._name,
            task=self._task,
            target=self._target,
            meshcat=self.meshcat,
            attendant=self,
        )
        if self._running:
            self.meshcat.DeleteButton(STOP)
        self._running = False
        save_episode(self._out, episode.record, episode.recording)
        write_report(self._out / "report.html", [report_of(episode)])
        outcome, message = episode.record["outcome"], episode.record["message"]
        why = f": {message}" if message else ""
        self._tell(f"{outcome}{why}. Report: {self._out / 'report.html'}. Next: 1 Look, or reset")
        return episode

    # As an attendant

    def decide(self, world: World, context: Context) -> Decision:
        """Waits for the person to go through the stages, and to say that the arm shall move."""
        self.decision, self._world, self._context = Decision(), world, context
        self._show_candidates()
        if self._resume is not None:
            self.advance(self._resume)
        self._resume = None
        while True:
            press = self._press()
            if press == LOOK:
                self.advance("cloud")
            elif press == PROPOSE:
                self.advance("candidates")
            elif press == ASK:
                self.ask()
            elif press == NEXT:
                self.pick(self._rank_after())
            elif press in self._picks:
                self.pick(self._picks.index(press))
            elif press == APPROVE:
                self.advance("motion")
            elif press == RUN and self._ready():
                self._running = True
                self.meshcat.AddButton(STOP, "Escape")
                self._tell("moving; STOP, or the Escape key, stops it")
                return self.decision

    def watch(self) -> None:
        """Raises Stopped where the person wants the arm to stop."""
        if self._running and self._new_click(STOP):
            raise Stopped("the STOP button", StopReason.OPERATOR)

    # The steps

    def advance(self, until: str) -> None:
        """Evaluates the stages up to a port of the pipeline, and shows what they say."""
        go_on(self.decision, self._world.pipeline, self._context, until)
        self._show()

    def ask(self) -> None:
        """Has the selector choose, also where a person has chosen before."""
        if self.decision.by_hand:
            said = self.decision.overruled
            self.decision.by_hand, self.decision.overruled = False, None
            self._put(said if isinstance(said, Choice) else None)
        self.advance("choice")

    def pick(self, rank: int) -> None:
        """Chooses a candidate by hand, the best confidence being rank 0."""
        self.advance("candidates")
        decision = self.decision
        candidates = decision.candidates
        if candidates is None:
            return
        if not decision.by_hand:
            decision.overruled, decision.by_hand = decision.said, True
        assert decision.shown is not None
        rank %= len(candidates)
        reason = f"A person chose the {candidate_color_name(rank)} candidate."
        choice = choose(int(candidates.index[rank]), decision.shown, candidates, reason)
        self._put(replace(choice, alternatives=()))  # this one and no other
        self._show()

    def _put(self, choice: Choice | None) -> None:
        """Makes this the choice that the stages after it see; None: that of the selector."""
        self.decision.choice, self.decision.motion, self.decision.error = choice, None, None
        if choice is not None:
            self._world.pipeline.fix(self._context, "choice", choice)

    def _rank_after(self) -> int:
        """The candidate after the one that is chosen; the first where none of them is."""
        decision = self.decision
        if decision.choice is None or decision.candidates is None:
            return 0
        rank = np.flatnonzero(decision.candidates.index == decision.choice.index)
        return 0 if len(rank) == 0 else int(rank[0]) + 1

    def _ready(self) -> bool:
        if self.decision.motion is None:
            self._tell("nothing is approved yet: 4 Approve plans the motion")
        return self.decision.motion is not None

    # What is shown

    def _show(self) -> None:
        draw(self.meshcat, self.decision, self._world.planning_model.X_WL0)
        self._show_candidates()
        self._tell(self._said())

    def _said(self) -> str:
        decision = self.decision
        if decision.error is not None:
            return f"{decision.error.outcome}: {decision.error}"
        if decision.choice is not None:
            kind = kind_and_settings(self.scenario.pipeline.selector)["kind"]
            who = "by hand" if decision.by_hand else kind
            said = f"chosen ({who}): {decision.choice.reason}"
            if decision.motion is None:
                return f"{said} Next: 4 Approve, or another by hand"
            return f"{said} The motion takes {decision.motion.duration:.1f} s. Next: 5 Run"
        if decision.candidates is not None:
            assert decision.feasible_grasps is not None
            n, k = len(decision.feasible_grasps), len(decision.candidates)
            return f"{n} feasible grasps, {k} candidates. Next: 3 Ask, or choose one by hand"
        if decision.cloud is not None:
            return f"{decision.cloud.size()} points on the table. Next: 2 Propose"
        return "Next: 1 Look"

    def _show_candidates(self) -> None:
        """Makes of each candidate a button: its colour and its score."""
        candidates, names = self.decision.candidates, list[str]()
        if candidates is not None:
            score = candidates.grasps.score[candidates.index]
            names = [
                f"by hand: {candidate_color_name(r)}, score {s:.2f}" for r, s in enumerate(score)
            ]
        if names != self._picks:
            for name in self._picks:
                self.meshcat.DeleteButton(name)
            for name in names:
                self._add_button(name)
            self._picks = names

    def _tell(self, status: str) -> None:
        """Shows the last picture with what is to be said below it."""
        self.status = status
        words = [status, *self._answers()]
        set_billboard(
            self.meshcat, BOARD, board_image(self._picture(), words), _BOARD_AT, np.array(EYE)
        )

    def _picture(self) -> Image | None:
        """What was sent to a model last; else what the camera saw and what was decided in it."""
        decision = self.decision
        exchanges = exchanges_of(decision)
        if exchanges and exchanges[-1].images and not decision.by_hand:
            return np.asarray(exchanges[-1].images[0])
        if decision.shown is None:
            return None
        return decision_image(decision.shown, decision.candidates, decision.choice)

    def _answers(self) -> list[str]:
        said = [e for e in exchanges_of(self.decision) if e.answer is not None or e.message]
        return [f"The model: {e.answer or e.message} ({e.status})" for e in said[-1:]]

    # The controls

    def _add_controls(self) -> None:
        self._picks = []
        for name in STEPS:
            self._add_button(name)
        k = self.scenario.pipeline.candidates.k
        self.meshcat.AddSlider(K_SLIDER, 0, 12, 1, 0 if k == "auto" else int(k))
        if self._strategies:
            now = self._strategies.index(self._vlm().strategy)
            self.meshcat.AddSlider(self._strategy_slider, 1, len(self._strategies), 1, now + 1)

    @property
    def _strategy_slider(self) -> str:
        return "strategy: " + ", ".join(f"{i} {s}" for i, s in enumerate(self._strategies, 1))

    def _vlm(self) -> Vlm:
        selector = self.scenario.pipeline.selector
        if not isinstance(selector, Vlm):
            raise InputError("only a model is asked by a strategy; valid: with --vlm")
        return selector

    def _add_button(self, name: str) -> None:
        self.meshcat.AddButton(name)
        self._clicked[name] = 0

    def _new_click(self, name: str) -> bool:
        clicks = int(self.meshcat.GetButtonClicks(name))
        new = clicks > self._clicked.get(name, 0)
        self._clicked[name] = clicks
        return new

    def _press(self) -> str:
        """Waits for a button. Raises _AgainError or _OverError where that is what it means."""
        press = self._next_press()
        if press == END:
            raise _OverError
        if press == RESET:
            self.scenario.random_seed += 1
            raise _AgainError
        return press

    def _next_press(self) -> str:
        if self._presses is not None:
            return next(self._presses, END)
        while not self._over.is_set():
            self._hear_sliders()
            for name in (*STEPS, *self._picks):
                if self._new_click(name):
                    return name
            time.sleep(_GLANCE)
        return END

    def _hear_sliders(self) -> None:
        """Builds the world anew where K or the strategy was changed, and goes on from there."""
        k = round(self.meshcat.GetSliderValue(K_SLIDER)) or "auto"
        if k != self.scenario.pipeline.candidates.k:
            self.set_k(k)
        if self._strategies:
            number = round(self.meshcat.GetSliderValue(self._strategy_slider))
            if (wanted := self._strategies[number - 1]) != self._vlm().strategy:
                self._vlm().strategy = wanted
                self._again("candidates")

    def set_k(self, k: int | str) -> None:
        """Asks for another number of candidates."""
        self.scenario.pipeline.candidates.k = k
        self._again("candidates")

    def _again(self, until: str) -> None:
        self._resume = until if self.decision.candidates is not None else None
        raise _AgainError

    def _wait_for(self, *buttons: str) -> None:
        while self._press() not in buttons:
            pass


def _strategies(selector: SelectorConfig) -> list[str]:
    """Those among which a person may change: none without a model, or with a text of one's own."""
    if not isinstance(selector, Vlm) or selector.prompt is not None:
        return []
    return list(STRATEGIES if selector.votes == 1 else PERMUTABLE)
