"""Grasps picked by hand, on scanned objects: good ones hold through lift and shake, others do not.

``shaken`` says how they are shaken. Poses were read off plots of the meshes, in their own frames:
YCB lies as it was scanned, GSO stands.
"""

import json

import numpy as np
import pytest
import trimesh
from shaken import Grip, outcome

from tog_drake.assets.collision import core_faces, core_of
from tog_drake.assets.mesh import ScannedMesh, Solid, read_mesh, solid_of
from tog_drake.assets.model import DENSITY, inertia_of, write_model
from tog_drake.assets.visual import write_visual

DOWN = (0, 0, -1)
GOOD = {
    # the wooden handle, 28 mm thick, where it balances
    "ycb_048_hammer": Grip((-0.030, -0.013, 0.016), DOWN, (0.93, 0.36, 0), 0.045),
    # the ear, 11 mm, from the side, its outer bar between the pads
    "ycb_025_mug": Grip((0.044, 0.0145, 0.042), (-1, 0, 0), (0, 1, 0), 0.03),
    # the cap, 39 mm, from above
    "ycb_006_mustard_bottle": Grip((-0.0155, -0.0235, 0.163), DOWN, (0, 1, 0), 0.05),
    # 1.1 kg by the middle of the body, 57 mm, across its narrow way, from the side
    "ycb_021_bleach_cleanser": Grip((-0.03, 0.0117, 0.110), (1, 0, 0), (0, 1, 0), 0.07),
    # the toy's body, 20 mm, from above its back
    "gso_Schleich_Lion_Action_Figure": Grip((0.008, 0.002, 0.040), DOWN, (0, 1, 0), 0.035),
    # the handle, 32 mm
    "ycb_043_phillips_screwdriver": Grip((0.005, 0.023, 0.016), DOWN, (-0.48, 0.88, 0), 0.05),
    # the handle, 23 mm, 6 cm from where it balances
    "ycb_033_spatula": Grip((-0.110, -0.0615, 0.012), DOWN, (0.35, 0.94, 0), 0.04),
    # 0.9 kg by its grip and trigger, 62 mm
    "ycb_035_power_drill": Grip((-0.020, 0.018, 0.023), DOWN, (1, 0, 0), 0.078),
}
ABSURD = [
    # on the air inside the mug
    ("ycb_025_mug", Grip((-0.020, 0.016, 0.050), DOWN, (0, 1, 0), 0.03), "lost"),
    # on a sliver, the upper 2 mm of a round handle
    (
        "ycb_043_phillips_screwdriver",
        Grip((0.005, 0.023, 0.0425), DOWN, (-0.48, 0.88, 0), 0.05),
        "lost",
    ),
    # on slopes, the last 5 mm of a handle's round end
    (
        "ycb_043_phillips_screwdriver",
        Grip((0.0565, 0.0495, 0.018), DOWN, (-0.48, 0.88, 0), 0.05),
        "lost",
    ),
    # turned by 90°, across the broad way of the bottle
    (
        "ycb_021_bleach_cleanser",
        Grip((-0.017, 0.0117, 0.110), (0, 1, 0), (1, 0, 0), 0.08),
        "does not fit",
    ),
    # softly at the end of a hammer: 1.1 Nm about pads whose friction at 15 N, some 7 mm from their
    # middle, can take 0.2 Nm
    (
        "ycb_048_hammer",
        Grip((0.035, -0.170, 0.016), DOWN, (0.93, 0.36, 0), 0.045, 15.0),
        "slipped",
    ),
]
FRICTION_ANGLE = 38.7  # [deg] of 0.8, that of pads and objects


@pytest.fixture(scope="module")
def scanned(shared_data, tmp_path_factory):
    """Makes a model of a scan as an import does, once; returns it and its lowest point [m]."""
    library, made = tmp_path_factory.mktemp("scans"), {}
    about = json.loads((shared_data / "objects" / "metadata.json").read_text())

    def make(name):
        if name not in made:
            mesh = read_mesh(shared_data / "objects" / name / about[name]["mesh"])
            solid = solid_of(mesh)
            made[name] = _write(
                library / name, solid, core_of(solid, core_faces(solid)), about[name]["mass_kg_ycb"]
            )
        return made[name]

    return make


def _write(folder, solid, core, mass):
    folder.mkdir()
    plain = ScannedMesh(solid.vertices, solid.faces, None, None, (200, 30, 30))
    write_visual(plain, solid, folder)
    inertia = inertia_of(solid, [], mass=mass, density=DENSITY)
    write_model(folder, core=core, skin=[], inertia=inertia)
    return folder / "model.sdf", core[0][:, 2].min()


def _made(folder, mesh):
    vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    return _write(folder, Solid(vertices, faces, True, 0, mesh.volume), (vertices, faces), 0.1)


@pytest.mark.parametrize("name", GOOD)
def test_a_good_grasp_of_a_scan_holds_through_lift_and_shake(scanned, name):
    assert outcome(*scanned(name), GOOD[name]) == "held"


@pytest.mark.parametrize(
    ("name", "grip", "expected"), ABSURD, ids=["air", "sliver", "slope", "turned", "far end"]
)
def test_an_absurd_grasp_of_a_scan_fails_as_it_must(scanned, name, grip, expected):
    assert outcome(*scanned(name), grip) == expected


@pytest.mark.parametrize(("slope", "expected"), [(-6, "held"), (6, "lost")])
def test_a_cone_is_held_if_its_sides_are_steeper_than_friction_asks(tmp_path, slope, expected):
    tangent = np.tan(np.radians(FRICTION_ANGLE + slope))
    middle, radius = 0.035, 0.015  # [m] between the pads
    profile = [(0, 0), (radius + middle * tangent, 0), (0.002, middle + 0.013 / tangent)]
    profile.append((0, profile[-1][1]))
    cone = trimesh.creation.revolve(np.array(profile), sections=32)
    at_tips = 2 * (radius + 0.01 * tangent)  # the fingers end 9.5 mm below
    grip = Grip((0, 0, middle), DOWN, (0, 1, 0), at_tips + 0.01)
    assert outcome(*_made(tmp_path / "cone", cone), grip) == expected


@pytest.mark.parametrize(
    ("height", "opening", "expected"),
    [(0.0, 0.07, "held"), (0.032, 0.07, "lost"), (0.0, 0.05, "does not fit")],
)
def test_a_ball_is_held_at_its_middle_by_a_wide_hand(tmp_path, height, opening, expected):
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.03)
    grip = Grip((0, 0, height), DOWN, (0, 1, 0), opening)
    assert outcome(*_made(tmp_path / "ball", ball), grip) == expected
