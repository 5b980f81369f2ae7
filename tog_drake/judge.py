"""Watches a simulated episode and says how it ended. Reads ground truth; nothing reads it back."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

from pydrake.geometry import GeometryId
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.framework import Context

from tog_drake.compliance import PartLabels, contact_forces
from tog_drake.executor import ExecutorState, Phase
from tog_drake.panda import FINGER_BODIES
from tog_drake.planning_model import HAND, PANDA
from tog_drake.stations.simulation import SimulationStation

LIFT = 0.10  # [m] success as in the paper: lifted so far ...
HOLD = 2.0  # [s] ... and held so long
COMPLIANT_SHARE = 0.8  # of the pads' force on allowed parts; less is a mixed grasp
_LIFT_OFF = 0.005  # [m] the object has left the table
_TOUCH = 0.5  # [N] less is no grip
_COLLISION = 30.0  # [N] a fingertip that brushes the table stays below this


@dataclass(frozen=True)
class Sample:
    """What the judge saw at one moment."""

    time: float  # [s] since the motion began; negative before
    lift: float  # [m] rise of the target's centre of mass
    held: dict[tuple[str, str], float]  # [N] pads' force by (model instance, part)
    hit: float  # [N] largest force of the robot on the known world or on itself


@dataclass(frozen=True)
class Verdict:
    """How the episode ended."""

    outcome: str
    message: str | None
    held: dict[str, float]  # part -> share of the pads' force at lift-off
    task_compliance: bool | None
    lift: float  # [m] at the end

    @property
    def grasp_success(self) -> bool:
        return self.outcome == "lifted"


class Judge:
    """Samples the world while an episode runs."""

    def __init__(self, station: SimulationStation, labels: PartLabels, target: str):
        self._station = station
        self._labels = labels
        self._target = target
        plant = station.plant
        self._pads = _geometries(plant, HAND, FINGER_BODIES)
        self._robot = _geometries(plant, HAND) | _geometries(plant, PANDA)
        self._known = self._robot | _anchored(plant)
        self._body = plant.get_body(plant.GetBodyIndices(plant.GetModelInstanceByName(target))[0])
        self._height_before: float | None = None
        self.samples: list[Sample] = []

    def observe(self, context: Context, state: ExecutorState) -> None:
        """Takes a sample of the station's ``cheat`` ports.

        Args:
            context: the station's.
            state: the executor's, for the time since the motion began.
        """
        pose = self._station.GetOutputPort("cheat.body_poses").Eval(context)[self._body.index()]
        height = float((pose @ self._body.default_com())[2])
        if self._height_before is None:
            self._height_before = height
        contacts = self._station.GetOutputPort("cheat.contact_results").Eval(context)
        forces = contact_forces(contacts)
        moving = state.phase in (Phase.MOVE, Phase.DONE, Phase.FAILED)
        self.samples.append(
            Sample(
                time=context.get_time() - state.start_time if moving else -1.0,
                lift=height - self._height_before,
                held=self._labels.held(forces, self._pads),
                hit=max((f for a, b, f in forces if self._is_hit(a, b)), default=0.0),
            )
        )

    def _is_hit(self, a: GeometryId, b: GeometryId) -> bool:
        pair = {a, b}
        if pair <= self._pads:
            return False  # the fingers closed on nothing
        return bool(pair & self._robot) and pair <= self._known

    def verdict(self, state: ExecutorState, task: str) -> Verdict:
        """Returns how the episode ended, from all samples."""
        assert state.motion is not None
        return verdict_of(
            self.samples,
            state.motion.phase_times,
            stopped=state.phase is Phase.FAILED,
            target=self._target,
            allowed=self._labels.objects[self._target].allowed(task),
        )


def verdict_of(
    samples: Sequence[Sample],
    phases: Mapping[str, float],
    *,
    stopped: bool,
    target: str,
    allowed: Collection[str] | None,
) -> Verdict:
    """Returns how an episode ended.

    Args:
        samples: in the order of time, at least one.
        phases: [s] when the motion's phases begin: close, lift.
        stopped: whether the arm no longer followed its command.
        target: model instance of the object that the task is about.
        allowed: its parts that the task allows; None where the task says none.
    """
    outcome, message = _outcome(samples, phases, stopped)
    held = _held_at_lift_off(samples, phases["lift"], target)
    compliance = None
    if allowed is not None:
        compliance = sum(held.get(part, 0.0) for part in allowed) >= COMPLIANT_SHARE
    return Verdict(outcome, message, held, compliance, samples[-1].lift)


def _outcome(
    samples: Sequence[Sample], phases: Mapping[str, float], stopped: bool
) -> tuple[str, str | None]:
    hit = max(samples, key=lambda s: s.hit)
    if stopped:
        return "collision", "the arm no longer followed its command and was stopped"
    if hit.hit > _COLLISION:
        return "collision", (
            f"the robot pressed {hit.hit:.0f} N against the table or itself "
            f"at {hit.time:.2f} s of the motion"
        )
    end, highest = samples[-1], max(s.lift for s in samples)
    if min(s.lift for s in samples if s.time >= end.time - HOLD) >= LIFT:
        return "lifted", None
    if end.lift >= LIFT:
        return "dropped", f"lifted by {end.lift:.2f} m, but not held there for {HOLD:g} s"
    if highest >= LIFT:
        return "dropped", f"lost after {highest:.2f} m of lift"
    closed = [s for s in samples if phases["close"] < s.time <= phases["lift"]]
    if not closed or sum(closed[-1].held.values()) < _TOUCH:
        return "empty", "the fingers closed and touched nothing"
    return "slipped", f"grasped, but lifted only {end.lift:.2f} m at the end"


def _held_at_lift_off(
    samples: Sequence[Sample], lift_begins: float, target: str
) -> dict[str, float]:
    """Shares of the pads' force by part of the target when it leaves the table."""
    lifting = [s for s in samples if s.time >= lift_begins]
    if not lifting:
        return {}  # stopped before the lift
    risen = [s for s in lifting if s.lift >= _LIFT_OFF]
    sample = (risen or lifting)[0]
    total = sum(sample.held.values())
    if total < _TOUCH:
        return {}
    return {
        part: force / total
        for (model, part), force in sorted(sample.held.items(), key=lambda item: -item[1])
        if model == target
    }


def _anchored(plant: MultibodyPlant) -> frozenset[GeometryId]:
    """What cannot move: the world that the robot knows."""
    return frozenset(
        geometry
        for body in plant.GetBodiesWeldedTo(plant.world_body())
        for geometry in plant.GetCollisionGeometriesForBody(body)
    )


def _geometries(
    plant: MultibodyPlant, model: str, bodies: tuple[str, ...] | None = None
) -> frozenset[GeometryId]:
    instance = plant.GetModelInstanceByName(model)
    return frozenset(
        geometry
        for index in plant.GetBodyIndices(instance)
        if bodies is None or plant.get_body(index).name() in bodies
        for geometry in plant.GetCollisionGeometriesForBody(plant.get_body(index))
    )
