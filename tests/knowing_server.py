"""A vision-language model that knows the right answers, and gives as many of them as it is told to.

It stands where a provider would, behind ``vlm_server``. What is right it learns before it is asked:
``learn`` looks at the world of every episode to come, draws the very question that will be asked
there, and reads in the simulated labels which answers lead to a grasp that the task allows. So a
table of successes must say of it what it did.
"""

import hashlib
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tog_drake.benchmark.cells import make_cells
from tog_drake.benchmark.episodes import EpisodeWork
from tog_drake.benchmark.method import make_methods
from tog_drake.benchmark.suite import Suite
from tog_drake.errors import NoChoice, Unanswered
from tog_drake.judge import complies
from tog_drake.pinhole import project
from tog_drake.selectors.scene import Scene
from tog_drake.selectors.strategies import STRATEGIES
from tog_drake.selectors.vlm import answers
from tog_drake.selectors.vlm.profiles import Profile, find_profile
from tog_drake.selectors.vlm.question import Options, Question
from tog_drake.selectors.vlm.selector import Vlm
from tog_drake.values import Grasps
from tog_drake.world import World, build_world, look

NOT_CARRIED_OUT = "pipeline: {executor: {look_time: 0.1, max_tracking_error: 1.0e-9}}"
"""YAML over a scenario: the arm is stopped at its first step. What was chosen is known by then, and
to carry it out would take most of the time."""
_NOBODY = "openai:any@http://127.0.0.1:1/v1"  # questions are the same, whoever is asked

Trial = tuple[str, str, int, str, str]
"""Scenario, object, seed, strategy, task: what a question is drawn from."""


@dataclass(frozen=True)
class Lesson:
    """A question, and the answers to it, as a model writes them."""

    trial: Trial  # that it is asked in
    digest: str  # of its text and images
    right: tuple[str, ...]
    wrong: tuple[str, ...]

    @property
    def leaves_a_choice(self) -> bool:
        """Whether there is an answer of both kinds: else how often a model is right cannot show."""
        return bool(self.right and self.wrong)


class KnowingModel:
    """Gives a right answer with a probability, else a wrong one, where there are both.

    Which, is drawn by the trial: neither the order of questions, nor how many ask at once, nor the
    machine that draws the pictures matters.
    """

    def __init__(self, lessons: Iterable[Lesson], probability: float, *, seed: int = 0):
        self._lessons = {lesson.digest: lesson for lesson in lessons}
        self.probability, self._seed = probability, seed
        self.was_right: dict[Trial, bool] = {}

    def __call__(self, text, images):
        """Answers as ``VlmServer`` wants it; raises KeyError for what it was not taught."""
        lesson = self._lessons[_digest(text, images)]
        drawn = hashlib.sha256(f"{self._seed} {self.probability} {lesson.trial}".encode())
        which, toss = (int(h, 16) for h in (drawn.hexdigest()[:12], drawn.hexdigest()[12:24]))
        is_right = toss < self.probability * 16**12
        if not lesson.leaves_a_choice:
            is_right = bool(lesson.right)
        among = lesson.right if is_right else lesson.wrong
        self.was_right[lesson.trial] = is_right
        return among[which % len(among)]


def trial_of(cell: Mapping) -> Trial:
    """Returns what the question of an episode is drawn from, by what its line says of the cell."""
    return tuple(cell[key] for key in ("scenario", "object", "seed", "strategy", "task"))


def learn(suite: Suite, strategies: Sequence[str], seeds: Iterable[int]) -> dict[Trial, Lesson]:
    """Returns the lesson of every question that a suite with NOT_CARRIED_OUT will ask a model."""
    methods = make_methods(["vlm"], strategies=strategies, models=[_NOBODY])
    cells = make_cells(suite, methods, list(seeds), text=NOT_CARRIED_OUT)
    work = EpisodeWork(Path())
    by_trial = {trial_of(cell.record(cell.trials[0])): cell for cell in cells}
    lessons, place = {}, None
    for trial in sorted(by_trial):  # by scenario, object and seed: each world is looked at once
        cell = by_trial[trial]
        scenario = work.configured(cell)
        if trial[:3] != place:
            place, world = trial[:3], build_world(scenario, target=cell.object)
            view, cloud, candidates, shares = _seen(world, scenario, cell.task)
        selector = scenario.pipeline.selector
        scene = Scene(
            view=view,
            points=np.asarray(cloud.xyzs().T, dtype=np.float64),
            candidates=candidates,
            task=cell.task,
            rendering=selector.rendering,
            seed=scenario.random_seed,
        )
        allowed = world.labels.objects[world.target].allowed(cell.task)
        fits = np.array([complies(share, allowed) for share in shares])
        lessons[trial] = _lesson(trial, scene, fits, selector)
    return lessons


def _seen(world: World, scenario, task):
    """What is seen in a world, and the shares of the target's parts in each closing region."""
    context = look(world, scenario, task).get_context()
    inner = world.pipeline.GetMyContextFromRoot(context)
    view, cloud, candidates = (
        world.pipeline.GetOutputPort(port).Eval(inner) for port in ("view", "cloud", "candidates")
    )
    query = world.station.GetOutputPort("cheat.query_object")
    regions = world.labels.closing_region(
        candidates.grasps, query.Eval(world.station.GetMyContextFromRoot(context))
    )
    shares = [
        {part: share for (model, part), share in region.items() if model == world.target}
        for region in regions
    ]
    return view, cloud, candidates, shares


def _lesson(trial: Trial, scene: Scene, fits, selector: Vlm) -> Lesson:
    """Args: ``fits`` (N,) whether the task allows each of the feasible grasps."""
    strategy = STRATEGIES[selector.strategy]
    profile = find_profile(selector.model.model, selector.model.profile)
    question = _question(scene, strategy)
    if isinstance(question.expects, Options):
        said = [(_label(label), fits[row]) for label, row in question.marks.items()]
    else:
        said = [*_places(scene, strategy, question, profile, fits)]
    texts = [part for part in question.parts if isinstance(part, str)]
    images = [part for part in question.parts if not isinstance(part, str)]
    texts.append(answers.instruction(profile, question.expects))
    return Lesson(
        trial,
        _digest("\n".join(texts), images),
        right=tuple(text for text, is_right in said if is_right),
        wrong=tuple(text for text, is_right in said if not is_right),
    )


class _Asked(Exception):
    """What a strategy asks first."""


def _question(scene, strategy) -> Question:
    def ask(question):
        raise _Asked(question)

    try:
        strategy(scene, ask)
    except _Asked as asked:
        return asked.args[0]
    raise AssertionError("the strategy asks nothing")


def _label(label: str) -> str:
    return json.dumps({"reasoning": "I know it.", "choice": label})


def _places(scene: Scene, strategy, question: Question, profile: Profile, fits):
    """Yields of each kind the first contact point that leads to a grasp of its kind, if any does.

    The grasp that is taken is not always the one pointed at: the nearest to the place is.
    """
    grasps = scene.candidates.grasps
    framing = scene.framing(Grasps.empty())
    pixels = framing.from_view(project(grasps.p_WContact, scene.view.intrinsics, scene.view.X_WC))
    for kind in (True, False):
        for u, v in np.round(pixels[fits == kind]).astype(int).tolist():
            point = {"x": u, "y": v, "label": "grasp"}
            text = json.dumps({"reasoning": "I know it.", "points": [point]})
            try:
                answer = answers.read(text, profile, question.expects)
                taken = strategy(scene, lambda _, answer=answer: answer).index
            except (Unanswered, NoChoice):
                continue
            if fits[taken] == kind:
                yield text, kind
                break


def _digest(text: str, images) -> str:
    total = hashlib.sha256(text.encode())
    for image in images:
        total.update(repr(image.shape).encode() + np.ascontiguousarray(image).tobytes())
    return total.hexdigest()
