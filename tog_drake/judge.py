"""Watches a simulated episode and says how it ended. Reads ground truth; nothing reads it back."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from pydrake.geometry import GeometryId
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import BodyIndex
from pydrake.systems.framework import Context

from tog_drake.compliance import ContactForce, PartLabels, contact_forces
from tog_drake.executor import ExecutorState, Phase
from tog_drake.panda import FINGER_BODIES
from tog_drake.planning_model import HAND, PANDA
from tog_drake.stations.simulation import SimulationStation
from tog_drake.values import Array

LIFT = 0.10  # [m] success as in the paper: lifted so far ...
HOLD = 2.0  # [s] ... and held so long
COMPLIANT_SHARE = 0.8  # of the pads' force on allowed parts; less is a mixed grasp
TURN = 10.0  # [deg] a stricter success lets the object turn no farther in the hand
_LIFT_OFF = 0.005  # [m] the object has left the table
_TOUCH = 0.5  # [N] less is no grip, nor shifts the lightest object (80 g) where it lies
_COLLISION = 30.0  # [N] a fingertip that brushes the table stays below this


@dataclass(frozen=True)
class Sample:
    """What the judge saw at one moment."""

    time: float  # [s] since the motion began; negative before
    lift: float  # [m] rise of the target's centre of mass
    held: dict[tuple[str, str], float]  # [N] pads' force by (model instance, part); see ``observe``
    hit: float  # [N] largest force of the robot on the known world or on itself
    touched: dict[tuple[str, str], float]  # [N] by (robot's body, what it meets), but the target
    others: dict[str, float]  # [m] rise of the other objects' centres of mass, by model instance
    R_HO: Array  # (3, 3) the target in the hand


@dataclass(frozen=True)
class Verdict:
    """How the episode ended."""

    outcome: str
    message: str | None
    held: dict[str, float]  # part -> share of the pads' force at lift-off
    task_compliance: bool | None
    lift: float  # [m] at the end
    turned: float | None  # [deg] in the hand from lift-off to the end; None if it was not lifted
    collisions: dict[str, float]  # [N] largest force of "robot's body / what it met"

    @property
    def grasp_success(self) -> bool:
        return self.outcome == "lifted"

    @property
    def strict_success(self) -> bool:
        return self.turned is not None and self.turned <= TURN


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
        self._name = _names(plant)
        self._hand = plant.GetBodyByName("panda_hand", plant.GetModelInstanceByName(HAND))
        self._objects = _objects(plant)
        self._height_before: dict[str, float] = {}
        self.samples: list[Sample] = []

    def observe(self, context: Context, state: ExecutorState) -> None:
        """Takes a sample of the station's ``cheat`` ports.

        Which part of a scanned object the pads press is looked at while the lift begins, until the
        object leaves the table: it takes three quarters of a look's time, and is read at lift-off
        alone. In other samples all of the object counts as unlabelled.

        Args:
            context: the station's.
            state: the executor's, for the time since the motion began.
        """
        poses = self._station.GetOutputPort("cheat.body_poses").Eval(context)
        height = {
            name: float((poses[body] @ center)[2]) for name, (body, center) in self._objects.items()
        }
        self._height_before = self._height_before or height
        rise = {name: z - self._height_before[name] for name, z in height.items()}
        contacts = self._station.GetOutputPort("cheat.contact_results").Eval(context)
        forces = contact_forces(contacts, self._robot)
        moving = state.phase in (Phase.MOVE, Phase.DONE, Phase.FAILED)
        time = context.get_time() - state.start_time if moving else -1.0
        R_WH, R_WO = (
            poses[body].rotation().matrix()
            for body in (self._hand.index(), self._objects[self._target][0])
        )
        self.samples.append(
            Sample(
                time=time,
                lift=rise.pop(self._target),
                held=self._labels.held(
                    contacts, self._pads, poses, by_part=self._is_lift_off_ahead(time, state)
                ),
                hit=max((f.newtons for f in forces if self._is_hit(f.a, f.b)), default=0.0),
                touched=self._touched(forces),
                others=rise,
                R_HO=R_WH.T @ R_WO,
            )
        )

    def _is_lift_off_ahead(self, time: float, state: ExecutorState) -> bool:
        """Whether the sample of this time may be that of ``_lift_off``."""
        if state.motion is None or time < (begins := state.motion.phase_times["lift"]):
            return False
        return not any(s.time >= begins and s.lift >= _LIFT_OFF for s in self.samples[-1:])

    def start_over(self) -> None:
        """Takes all samples so far for a time before the motion: another one is to come."""
        self.samples = [replace(sample, time=-1.0) for sample in self.samples]
        self._height_before = {}  # what was tried before may have moved things

    def _is_hit(self, a: GeometryId, b: GeometryId) -> bool:
        """Whether a contact of the robot is one with itself or with the known world."""
        if a in self._pads and b in self._pads:
            return False  # the fingers closed on nothing
        return a in self._known and b in self._known

    def _touched(self, forces: list[ContactForce]) -> dict[tuple[str, str], float]:
        """The force of each body of the robot on what it should not meet."""
        touched: dict[tuple[str, str], float] = {}
        for a, b, newtons, _ in forces:
            if a in self._pads and b in self._pads:
                continue
            robot, other = sorted((a, b), key=lambda g: (g not in self._robot, self._name[g]))
            names = self._name[robot], self._name[other]
            if names[1] != self._target:
                touched[names] = touched.get(names, 0.0) + newtons
        return touched

    def collisions(self) -> dict[str, float]:
        """Returns what the robot has met so far that it should not; see ``Verdict``."""
        return _collisions(self.samples)

    def verdict(self, state: ExecutorState, task: str) -> Verdict:
        """Returns how the episode ended, from all samples.

        Where the arm was stopped on its way to a further look, there is no motion with phases.
        """
        never = {"close": np.inf, "lift": np.inf}
        return verdict_of(
            self.samples,
            never if state.motion is None else state.motion.phase_times,
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
    outcome, message = _outcome(samples, phases, stopped, target)
    held = _held_at_lift_off(samples, phases["lift"], target)
    compliance = complies(held, allowed)
    turned = _turned(samples, phases["lift"]) if outcome == "lifted" else None
    collisions = _collisions(samples)
    return Verdict(outcome, message, held, compliance, samples[-1].lift, turned, collisions)


def complies(held: Mapping[str, float], allowed: Collection[str] | None) -> bool | None:
    """Returns whether the shares of the pads' force by part are as allowed; None: nothing said."""
    if allowed is None:
        return None
    return sum(held.get(part, 0.0) for part in allowed) >= COMPLIANT_SHARE


def _outcome(
    samples: Sequence[Sample], phases: Mapping[str, float], stopped: bool, target: str
) -> tuple[str, str | None]:
    hit = max(samples, key=lambda s: s.hit)
    if stopped:
        return "collision", "the arm no longer followed its command and was stopped"
    if hit.hit > _COLLISION:
        return "collision", (
            f"the robot pressed {hit.hit:.0f} N against the table or itself "
            + (f"at {hit.time:.2f} s of the motion" if hit.time >= 0 else "before the last motion")
        )
    end, highest = samples[-1], max(s.lift for s in samples if s.time >= 0)
    hold = [s for s in samples if s.time >= end.time - HOLD]
    if min(s.lift for s in hold) >= LIFT:
        if max(_grip(s, target)[target] for s in hold) < _TOUCH:
            return "wrong_object", f"{target} came up with what the fingers hold"
        return "lifted", None
    if end.lift >= LIFT:
        return "dropped", f"lifted by {end.lift:.2f} m, but not held there for {HOLD:g} s"
    if highest >= LIFT:
        return "dropped", f"lost after {highest:.2f} m of lift"
    for other, rise in end.others.items():
        if rise >= LIFT:
            return "wrong_object", f"lifted {other} instead of {target}"
    closed = [s for s in samples if phases["close"] < s.time <= phases["lift"]]
    grip = _grip(closed[-1], target) if closed else {}
    firmest = max(grip, key=lambda name: grip[name], default=target)
    if sum(grip.values()) < _TOUCH:
        return "empty", "the fingers closed and touched nothing"
    if firmest != target:
        return "wrong_object", f"the fingers closed on {firmest} instead of {target}"
    return "slipped", f"grasped, but lifted only {end.lift:.2f} m at the end"


def _grip(sample: Sample, target: str) -> dict[str, float]:
    """The force of the fingers on each object [N]."""
    grip = {target: sum(f for (model, _), f in sample.held.items() if model == target)}
    for (robot, other), newtons in sample.touched.items():
        if robot in FINGER_BODIES and other in sample.others:
            grip[other] = grip.get(other, 0.0) + newtons
    return grip


def _lift_off(samples: Sequence[Sample], lift_begins: float) -> Sample | None:
    """When the target leaves the table; when the lift begins, if it never does."""
    lifting = [s for s in samples if s.time >= lift_begins]
    risen = [s for s in lifting if s.lift >= _LIFT_OFF]
    return next(iter(risen or lifting), None)  # None: stopped before the lift


def _held_at_lift_off(
    samples: Sequence[Sample], lift_begins: float, target: str
) -> dict[str, float]:
    """Shares of the pads' force by part of the target when it leaves the table."""
    sample = _lift_off(samples, lift_begins)
    total = 0.0 if sample is None else sum(sample.held.values())
    if sample is None or total < _TOUCH:
        return {}
    return {
        part: force / total
        for (model, part), force in sorted(sample.held.items(), key=lambda item: -item[1])
        if model == target
    }


def _turned(samples: Sequence[Sample], lift_begins: float) -> float | None:
    """The angle [deg] by which the target turned in the hand from lift-off to the end."""
    before = _lift_off(samples, lift_begins)
    if before is None:
        return None
    # tr R = 1 + 2 cos θ, and the antisymmetric part of R has the norm √2 sin θ.
    R = before.R_HO.T @ samples[-1].R_HO
    return float(np.degrees(np.arctan2(np.linalg.norm(R - R.T) / np.sqrt(2), np.trace(R) - 1)))


def _collisions(samples: Sequence[Sample]) -> dict[str, float]:
    """The largest force [N] of each pair that should not have met, the hardest first."""
    largest: dict[str, float] = {}
    for sample in samples:
        for pair, newtons in sample.touched.items():
            name = " / ".join(pair)
            if newtons >= _TOUCH:
                largest[name] = max(newtons, largest.get(name, 0.0))
    return dict(sorted(largest.items(), key=lambda item: -item[1]))


def _names(plant: MultibodyPlant) -> dict[GeometryId, str]:
    """What to call each collision geometry: its body, of the robot; else its model instance."""
    names = {}
    for index in range(plant.num_bodies()):
        body = plant.get_body(BodyIndex(index))
        model = plant.GetModelInstanceName(body.model_instance())
        for geometry in plant.GetCollisionGeometriesForBody(body):
            names[geometry] = body.name() if model in (PANDA, HAND) else model
    return names


def _objects(plant: MultibodyPlant) -> dict[str, tuple[BodyIndex, Array]]:
    """The free bodies and their centres of mass, by model instance: what can be lifted."""
    bodies = [plant.get_body(index) for index in sorted(plant.GetFloatingBaseBodies())]
    return {
        plant.GetModelInstanceName(body.model_instance()): (body.index(), body.default_com())
        for body in bodies
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
