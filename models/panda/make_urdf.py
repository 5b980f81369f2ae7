"""Writes panda_arm.urdf and panda_hand.urdf beside itself: ``python make_urdf.py [FOLDER]``.

A link is a few *tubes* (a polyline with a radius) and boxes. From that one description follow
- the visuals: cylinders joined by spheres, with a dark ring where two links meet;
- the collision geometry: spheres that cover the tubes (distances between spheres and boxes are
  closed-form in Drake; capsules and cylinders go through FCL, which can throw), and the boxes;
- the inertia: the published mass spread evenly over the shapes.

Sources: the frames, limits and hand dimensions of ``tog_drake.panda``; torque limits from Franka
Robotics' "Robot and interface specifications"; reflected rotor inertias as published by Franka
for the FR3 (0.6057, 0.4625, 0.2055 kg m² over a gear ratio of 100); link masses as in the public
franka_description (they add up to the data sheet's 18 kg). The shapes were not measured: they were
drawn by hand after the data sheet's outline and then compared with the collision spheres of
Drake's franka_description (centres and radii read as facts, no file taken), after which
panda_link5 was redrawn, its line and its thickness.
"""

import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal
from xml.etree import ElementTree

import numpy as np

from tog_drake import panda
from tog_drake.values import Array

Point = tuple[float, float, float]
Numbers = Sequence[float] | Array

WHITE, DARK, GREY = "0.93 0.93 0.92 1", "0.15 0.16 0.17 1", "0.40 0.41 0.43 1"
EFFORT = (87.0, 87.0, 87.0, 87.0, 12.0, 12.0, 12.0)  # [N m]
ROTOR_INERTIA = (6.057e-5, 6.057e-5, 4.625e-5, 4.625e-5, 2.055e-5, 2.055e-5, 2.055e-5)
GEAR_RATIO = 100.0
FINGER_EFFORT = 70.0  # [N] the hand's continuous grasping force
FINGER_VELOCITY = 0.2  # [m/s]
FINGER_Z = 0.0584  # [m] finger joints beyond H
COVER_STEP = 0.05  # [m] between the spheres that cover a tube


@dataclass(frozen=True)
class Tube:
    """A polyline with a radius. A flat end stops at its point; a round one adds a half sphere."""

    points: Sequence[Point]
    radius: float
    flat_start: bool = False
    flat_end: bool = False
    colour: str = WHITE
    solid: bool = True  # False: only drawn

    def spheres(self) -> Iterator[tuple[Array, float]]:
        """Spheres (centre, radius) that cover the tube; one sits at every bend and round end."""
        p = np.asarray(self.points)
        along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(p, axis=0), axis=1))])
        knots = along.copy()
        shortest = COVER_STEP / 2 if len(p) > 2 else min(COVER_STEP, along[-1]) / 2
        knots[0] += min(shortest, along[1]) if self.flat_start else 0.0
        knots[-1] -= min(shortest, along[-1] - along[-2]) if self.flat_end else 0.0
        s = [knots[0]]
        for start, end in pairwise(knots):
            count = int(np.ceil((end - start) / COVER_STEP - 1e-9))
            s.extend(np.linspace(start, end, count + 1)[1:])
        half = max(np.diff(s).max(initial=0.0) / 2, knots[0], along[-1] - knots[-1])
        radius = round(float(np.hypot(self.radius, half)), 4) + 1e-4
        for row in np.stack([np.interp(s, along, p[:, i]) for i in range(3)], axis=1):
            yield row, radius


@dataclass(frozen=True)
class Box:
    """An axis-aligned box in the link's frame."""

    lower: Point
    upper: Point
    colour: str = GREY
    solid: bool = True  # False: only drawn
    drawn: bool = True


@dataclass(frozen=True)
class Link:
    name: str
    mass: float = 0.0  # [kg]
    shapes: Sequence[Tube | Box] = field(default_factory=tuple)
    hydroelastic: Literal["", "compliant", "rigid"] = ""  # "": point contact


def ring(at: Point, axis: int, radius: float) -> Tube:
    """The dark seam where a link meets the next, 8 mm wide, at ``at`` along axis 0, 1 or 2."""
    step = np.zeros(3)
    step[axis] = 0.004
    ends = [tuple(np.asarray(at) - step), tuple(np.asarray(at) + step)]
    return Tube(ends, radius + 0.0005, True, True, DARK, solid=False)


ARM = (
    Link(
        "panda_link0",
        2.92,
        (
            Tube([(-0.105, 0.045, 0.05), (-0.01, 0.045, 0.05)], 0.05),
            Tube([(-0.105, -0.045, 0.05), (-0.01, -0.045, 0.05)], 0.05),
            Tube([(-0.105, 0, 0.06), (0, 0, 0.06), (0, 0, 0.141)], 0.06, flat_end=True),
            Box((-0.14, -0.095, 0.0), (0.07, 0.095, 0.012), DARK, solid=False),
            ring((0, 0, 0.141), 2, 0.06),
        ),
    ),
    Link(
        "panda_link1",
        2.74,
        (
            Tube([(0, 0, -0.192), (0, 0, -0.12), (0, -0.035, -0.05)], 0.06, True),
            Tube([(0, -0.035, -0.05), (0, -0.07, 0), (0, 0, 0)], 0.06, flat_end=True),
            ring((0, 0, 0), 1, 0.06),
        ),
    ),
    Link(
        "panda_link2",
        2.74,
        (
            Tube([(0, 0, 0), (0, 0, 0.07), (0, -0.05, 0.035)], 0.06, True),
            Tube([(0, -0.05, 0.035), (0, -0.12, 0), (0, -0.194, 0)], 0.06, flat_end=True),
            ring((0, -0.194, 0), 1, 0.06),
        ),
    ),
    Link(
        "panda_link3",
        2.38,
        (
            Tube([(0, 0, -0.122), (0, 0, -0.085), (0.042, 0.03, -0.035)], 0.06, True),
            Tube([(0.042, 0.03, -0.035), (0.0825, 0.06, 0), (0.0825, 0, 0)], 0.057, flat_end=True),
            ring((0.0825, 0, 0), 1, 0.057),
        ),
    ),
    Link(
        "panda_link4",
        2.38,
        (
            Tube([(0, 0, 0), (0, 0, 0.06), (-0.042, 0.035, 0.03)], 0.057, True),
            Tube(
                [(-0.042, 0.035, 0.03), (-0.0825, 0.085, 0), (-0.0825, 0.125, 0)],
                0.057,
                flat_end=True,
            ),
            ring((-0.0825, 0.125, 0), 1, 0.057),
        ),
    ),
    Link(
        "panda_link5",
        2.74,
        (
            Tube([(0, 0, -0.259), (0, 0, -0.215), (0, 0.03, -0.19)], 0.057, True),
            Tube([(0, 0.03, -0.19), (0, 0.074, -0.14), (0, 0.085, -0.05), (0, 0.085, 0)], 0.038),
            Tube([(0, 0.085, 0), (0, 0.05, 0)], 0.05, flat_end=True),
            ring((0, 0.05, 0), 1, 0.05),
        ),
    ),
    Link(
        "panda_link6",
        1.55,
        (
            Tube([(0, 0, -0.05), (0, 0, 0.015), (0.088, 0.02, 0)], 0.05, True),
            Tube([(0.088, 0.03, 0), (0.088, -0.05, 0)], 0.05, flat_end=True),
            ring((0.088, -0.05, 0), 1, 0.05),
        ),
    ),
    Link(
        "panda_link7",
        0.54,
        (
            Tube([(0, 0, 0.05), (0, 0, 0.107)], 0.045, True, True),
            Tube([(0, 0, 0.08), (0.042, 0.042, 0.08)], 0.024, flat_end=True),
            Tube([(0.041, 0.041, 0.08), (0.044, 0.044, 0.08)], 0.02, True, True, DARK, solid=False),
            ring((0, 0, 0.1), 2, 0.045),
        ),
    ),
    Link("panda_link8"),
)

HALF_PAD = panda.PAD_WIDTH / 2
PAD_Z = panda.GRASP_Z - FINGER_Z  # [m] the pads' middle, in a finger's frame
PALM_END = panda.PALM_Z + PAD_Z  # [m] the palm's face, in a finger's frame


def finger(name: str, side: int) -> Link:
    """A finger on ``side`` of the plane y = 0 of its frame, in which its pad's face lies."""

    def box(x: float, y: tuple[float, float], z: tuple[float, float], colour: str) -> Box:
        low, high = sorted((side * y[0], side * y[1]))
        return Box((-x, low, z[0]), (x, high, z[1]), colour)

    pad = box(HALF_PAD, (0.0, panda.FINGER_THICKNESS), (PAD_Z - HALF_PAD, PAD_Z + HALF_PAD), DARK)
    shank = box(0.0105, (0.004, 0.0152), (PALM_END, PAD_Z - HALF_PAD), GREY)
    # What is gripped is compliant. Against a rigid finger its contact costs two thirds of that
    # against a compliant one, and it slides as Coulomb says: the tilted edges of a patch between
    # two compliant bodies add up to a quarter.
    return Link(name, 0.1, (pad, shank), hydroelastic="rigid")


HAND = (
    Link(
        "panda_hand",
        0.73,
        (
            # One box collides; a rounded body is drawn inside it.
            Box((-0.0315, -0.102, 0.0), (0.0315, 0.102, 0.0659), drawn=False),
            Box((-0.0315, -0.0705, 0.0), (0.0315, 0.0705, 0.05), GREY, solid=False),
            Tube([(0, -0.0705, 0), (0, -0.0705, 0.05)], 0.0315, True, True, GREY, solid=False),
            Tube([(0, 0.0705, 0), (0, 0.0705, 0.05)], 0.0315, True, True, GREY, solid=False),
            Box((-0.024, -0.09, 0.05), (0.024, 0.09, 0.0659), DARK, solid=False),
        ),
        hydroelastic="compliant",
    ),
    finger("panda_leftfinger", 1),
    finger("panda_rightfinger", -1),
)


def text(values: Numbers) -> str:
    """Lengths and inertias to ten digits, without negative zeros."""
    return " ".join(f"{float(v) + 0.0:.10g}" for v in values)


def add_origin(parent: ElementTree.Element, xyz: Numbers, rpy: Numbers) -> None:
    """Angles keep fifteen digits: a truncated π would move the fingertips."""
    angles = " ".join(repr(round(float(angle), 15) + 0.0) for angle in rpy)
    ElementTree.SubElement(parent, "origin", xyz=text(xyz), rpy=angles)


def add_geometry(
    link: ElementTree.Element,
    kind: str,
    shape: tuple[str, dict[str, Any]],
    xyz: Numbers,
    rpy: Numbers = (0.0, 0.0, 0.0),
) -> ElementTree.Element:
    """Adds a <visual> or <collision> and returns it."""
    element = ElementTree.SubElement(link, kind)
    add_origin(element, xyz, rpy)
    geometry = ElementTree.SubElement(element, "geometry")
    name, sizes = shape
    ElementTree.SubElement(geometry, name, {k: text(np.atleast_1d(v)) for k, v in sizes.items()})
    return element


def add_visuals(link: ElementTree.Element, shape: Tube | Box) -> None:
    drawn: list[ElementTree.Element] = []
    if isinstance(shape, Box):
        lower, upper = np.asarray(shape.lower), np.asarray(shape.upper)
        box = ("box", {"size": upper - lower})
        drawn.append(add_geometry(link, "visual", box, (lower + upper) / 2))
    else:
        points = np.asarray(shape.points)
        for start, end in pairwise(points):
            d = end - start
            rpy = (0.0, np.arctan2(np.hypot(d[0], d[1]), d[2]), np.arctan2(d[1], d[0]))
            size = {"radius": shape.radius, "length": np.linalg.norm(d)}
            drawn.append(add_geometry(link, "visual", ("cylinder", size), (start + end) / 2, rpy))
        round_points = points[int(shape.flat_start) : len(points) - int(shape.flat_end)]
        for point in round_points:
            sphere = ("sphere", {"radius": shape.radius})
            drawn.append(add_geometry(link, "visual", sphere, point))
    for visual in drawn:
        material = ElementTree.SubElement(visual, "material", name=f"panda_{shape.colour}")
        ElementTree.SubElement(material, "color", rgba=shape.colour)


def add_collisions(link: ElementTree.Element, shape: Tube | Box, hydroelastic: str) -> None:
    added: list[ElementTree.Element] = []
    if isinstance(shape, Box):
        lower, upper = np.asarray(shape.lower), np.asarray(shape.upper)
        box = ("box", {"size": upper - lower})
        added.append(add_geometry(link, "collision", box, (lower + upper) / 2))
    else:
        for centre, radius in shape.spheres():
            added.append(add_geometry(link, "collision", ("sphere", {"radius": radius}), centre))
    for collision in added:
        properties = ElementTree.SubElement(collision, "drake:proximity_properties")
        values = {"mu_dynamic": 0.8, "mu_static": 0.8, "hunt_crossley_dissipation": 1.25}
        if hydroelastic:
            ElementTree.SubElement(properties, f"drake:{hydroelastic}_hydroelastic")
        if hydroelastic == "compliant":
            values |= {"hydroelastic_modulus": 1e7, "mesh_resolution_hint": 0.01}
        for name, value in values.items():
            ElementTree.SubElement(properties, f"drake:{name}", value=f"{value:g}")


def add_inertia(element: ElementTree.Element, link: Link) -> None:
    """The link's mass, spread by volume over its covering spheres and boxes."""
    volumes: list[float] = []
    centres: list[Array] = []
    unit_inertias: list[Array] = []
    for shape in link.shapes:
        if not shape.solid:
            continue
        if isinstance(shape, Box):
            size = np.subtract(shape.upper, shape.lower)
            volumes.append(float(np.prod(size)))
            centres.append(np.add(shape.upper, shape.lower) / 2)
            unit_inertias.append(np.diag(np.sum(size**2) - size**2) / 12)
        else:
            for centre, radius in shape.spheres():
                volumes.append(4 / 3 * np.pi * radius**3)
                centres.append(centre)
                unit_inertias.append(0.4 * radius**2 * np.eye(3))
    masses = link.mass * np.asarray(volumes) / np.sum(volumes)
    centre = masses @ np.asarray(centres) / link.mass
    inertia = np.zeros((3, 3))
    for mass, position, unit in zip(masses, centres, unit_inertias, strict=True):
        r = position - centre
        inertia += mass * (unit + r @ r * np.eye(3) - np.outer(r, r))
    inertial = ElementTree.SubElement(element, "inertial")
    add_origin(inertial, centre, (0.0, 0.0, 0.0))
    ElementTree.SubElement(inertial, "mass", value=text([link.mass]))
    axes = [
        ("ixx", 0, 0),
        ("ixy", 0, 1),
        ("ixz", 0, 2),
        ("iyy", 1, 1),
        ("iyz", 1, 2),
        ("izz", 2, 2),
    ]
    terms = {name: text([round(inertia[i, j], 12)]) for name, i, j in axes}
    ElementTree.SubElement(inertial, "inertia", terms)


def add_link(robot: ElementTree.Element, link: Link) -> None:
    element = ElementTree.SubElement(robot, "link", name=link.name)
    if link.mass:
        add_inertia(element, link)
    for shape in link.shapes:
        if not isinstance(shape, Box) or shape.drawn:
            add_visuals(element, shape)
    for shape in link.shapes:
        if shape.solid:
            add_collisions(element, shape, link.hydroelastic)


def add_joint(
    robot: ElementTree.Element,
    name: str,
    kind: str,
    parent: str,
    child: str,
    xyz: Numbers,
    rpy: Numbers = (0.0, 0.0, 0.0),
    axis: Numbers = (0.0, 0.0, 1.0),
    limit: dict[str, float] | None = None,
    rotor_inertia: float | None = None,
) -> None:
    """Adds a joint and, where it moves, its limits and its actuator."""
    joint = ElementTree.SubElement(robot, "joint", name=name, type=kind)
    add_origin(joint, xyz, rpy)
    ElementTree.SubElement(joint, "parent", link=parent)
    ElementTree.SubElement(joint, "child", link=child)
    if limit is None:
        return
    ElementTree.SubElement(joint, "axis", xyz=text(axis))
    ElementTree.SubElement(joint, "limit", {k: text([v]) for k, v in limit.items()})
    transmission = ElementTree.SubElement(robot, "transmission", name=f"{name}_transmission")
    ElementTree.SubElement(transmission, "type").text = "transmission_interface/SimpleTransmission"
    ElementTree.SubElement(transmission, "joint", name=name)
    # The actuator has its joint's name: gains and effort limits are then looked up by one name.
    actuator = ElementTree.SubElement(transmission, "actuator", name=name)
    if rotor_inertia is not None:
        ElementTree.SubElement(actuator, "drake:rotor_inertia", value=text([rotor_inertia]))
        ElementTree.SubElement(actuator, "drake:gear_ratio", value=text([GEAR_RATIO]))


def make_arm() -> ElementTree.Element:
    robot = new_robot("panda")
    for link in ARM:
        add_link(robot, link)
    for i, name in enumerate(panda.JOINT_NAMES):
        alpha = panda.DH_ALPHA[i]
        c, s = round(np.cos(alpha)), round(np.sin(alpha))  # multiples of 90°
        xyz = (panda.DH_A[i], -s * panda.DH_D[i], c * panda.DH_D[i])
        limit = {
            "lower": panda.Q_LOWER[i],
            "upper": panda.Q_UPPER[i],
            "velocity": panda.V_MAX[i],
            "effort": EFFORT[i],
            "drake:acceleration": panda.A_MAX[i],
            "drake:jerk": panda.J_MAX[i],
        }
        add_joint(
            robot,
            name,
            "revolute",
            f"panda_link{i}",
            f"panda_link{i + 1}",
            xyz,
            (alpha, 0.0, 0.0),
            limit=limit,
            rotor_inertia=ROTOR_INERTIA[i],
        )
    flange = (0.0, 0.0, panda.FLANGE_Z)
    add_joint(robot, "panda_joint8", "fixed", "panda_link7", "panda_link8", flange)
    group = ElementTree.SubElement(robot, "drake:collision_filter_group", name="wrist")
    for member in ("panda_link5", "panda_link7"):
        ElementTree.SubElement(group, "drake:member", link=member)
    ElementTree.SubElement(group, "drake:ignored_collision_filter_group", name="wrist")
    return robot


def make_hand() -> ElementTree.Element:
    robot = new_robot("panda_hand")
    for link in HAND:
        add_link(robot, link)
    limit = {
        "lower": 0.0,
        "upper": panda.MAX_OPENING / 2,
        "velocity": FINGER_VELOCITY,
        "effort": FINGER_EFFORT,
    }
    fingers = ("panda_leftfinger", "panda_rightfinger")
    for name, child, side in zip(panda.FINGER_JOINT_NAMES, fingers, (1.0, -1.0), strict=True):
        at, axis = (0.0, 0.0, FINGER_Z), (0.0, side, 0.0)
        add_joint(robot, name, "prismatic", "panda_hand", child, at, axis=axis, limit=limit)
    return robot


def new_robot(name: str) -> ElementTree.Element:
    robot = ElementTree.Element("robot", {"name": name, "xmlns:drake": "http://drake.mit.edu"})
    robot.append(ElementTree.Comment(" Written by make_urdf.py; change that and run it again. "))
    return robot


def main() -> None:
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent
    for name, robot in (("panda_arm", make_arm()), ("panda_hand", make_hand())):
        ElementTree.indent(robot)
        (folder / f"{name}.urdf").write_text(
            '<?xml version="1.0"?>\n' + ElementTree.tostring(robot, encoding="unicode") + "\n"
        )


if __name__ == "__main__":
    main()
