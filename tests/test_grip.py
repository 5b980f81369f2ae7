"""How hard the simulated hand grips, and how well things stick: a block held in mid-air."""

import numpy as np
import pytest
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.analysis import Simulator

from tog_drake.panda import FINGER_BODIES, X_HG
from tog_drake.scenario import LOOK_POSTURE, Scenario, parse_scenario
from tog_drake.stations.simulation import SimulationStation

MASS, WIDTH, GRAVITY = 0.5, 0.024, 9.81  # [kg], [m] between the pads, [m/s²]
BLOCK = """
<sdf version="1.9" xmlns:drake="http://drake.mit.edu"><model name="block"><link name="base">
  <inertial><mass>0.5</mass>
    <inertia><ixx>2e-4</ixx><ixy>0</ixy><ixz>0</ixz><iyy>3e-4</iyy><iyz>0</iyz><izz>2e-4</izz></inertia>
  </inertial>
  <collision name="block"><geometry><box><size>0.04 0.024 0.04</size></box></geometry>
    <drake:proximity_properties>
      <drake:compliant_hydroelastic/><drake:hydroelastic_modulus>1e7</drake:hydroelastic_modulus>
      <drake:hunt_crossley_dissipation>1.25</drake:hunt_crossley_dissipation>
      <drake:mu_dynamic>0.8</drake:mu_dynamic><drake:mu_static>0.8</drake:mu_static>
    </drake:proximity_properties></collision>
</link></model></sdf>
"""


def _scenario(folder, text=""):
    (folder / "block.sdf").write_text(BLOCK)
    table = "{add_directives: {file: package://tog_drake/scenes/table.dmd.yaml}}"
    block = f"{{add_model: {{name: block, file: 'file://{folder}/block.sdf'}}}}"
    scenario = parse_scenario(f"directives: [{table}, {block}]", "test", Scenario())
    scenario.cameras = {}
    half = WIDTH / 2 + 0.0005
    scenario.initial_position["hand"] = dict.fromkeys(scenario.initial_position["hand"], half)
    return parse_scenario(text, "test", scenario) if text else scenario


class _Grip:
    """The hand closes on the block; then time can be let pass."""

    def __init__(self, scenario):
        self.station = SimulationStation(scenario)
        self.plant = self.station.plant
        self.simulator = Simulator(self.station)
        self.context = self.simulator.get_mutable_context()
        self.station.GetInputPort("panda.position").FixValue(self.context, LOOK_POSTURE)
        self.station.GetInputPort("hand.position").FixValue(self.context, [-0.02])
        X_WG = self._poses("panda_hand") @ RigidTransform(X_HG)
        across = X_WG.rotation().col(1)  # level, in this posture
        level = np.cross(across, [0, 0, 1.0])
        R_WO = RotationMatrix(np.stack([level, across, [0, 0, 1.0]], axis=-1))
        plant_context = self.plant.GetMyMutableContextFromRoot(self.context)
        block = self.plant.GetBodyByName("base", self.plant.GetModelInstanceByName("block"))
        self.plant.SetFreeBodyPose(plant_context, block, RigidTransform(R_WO, X_WG.translation()))
        self.block = block

    def _poses(self, name):
        body = self.plant.GetBodyByName(name)
        return self.station.GetOutputPort("cheat.body_poses").Eval(self.context)[body.index()]

    def falling(self):
        """How fast the block falls [m/s]."""
        plant_context = self.plant.GetMyContextFromRoot(self.context)
        return -self.plant.EvalBodySpatialVelocityInWorld(
            plant_context, self.block
        ).translational()[2]

    def squeeze(self):
        """The force of each finger on the block along the closing direction [N]."""
        across = self._poses("panda_hand").rotation().col(1)
        contacts = self.station.GetOutputPort("cheat.contact_results").Eval(self.context)
        return [
            abs(contacts.hydroelastic_contact_info(i).F_Ac_W().translational() @ across)
            for i in range(contacts.num_hydroelastic_contacts())
        ]


@pytest.mark.parametrize("force", [30.0, 70.0])
def test_each_finger_presses_with_the_grip_force(tmp_path, force):
    grip = _Grip(_scenario(tmp_path, f"grip_force: {force}"))
    grip.simulator.AdvanceTo(0.5)
    assert grip.squeeze() == pytest.approx([force, force], rel=0.03)


def test_a_block_slides_between_slippery_fingers_as_coulomb_says(tmp_path):
    force, friction = 30.0, 0.07
    grip = _Grip(_scenario(tmp_path, f"{{grip_force: {force}, object_friction: {friction}}}"))
    grip.simulator.AdvanceTo(0.08)  # the impact of closing is over
    before = grip.falling()
    grip.simulator.AdvanceTo(0.12)
    resisting = MASS * (GRAVITY - (grip.falling() - before) / 0.04)
    assert resisting == pytest.approx(2 * friction * force, rel=0.05)


def test_it_is_held_with_the_friction_of_the_models(tmp_path):
    grip = _Grip(_scenario(tmp_path, "grip_force: 30"))
    grip.simulator.AdvanceTo(0.3)
    assert grip.falling() < 0.005


def test_the_friction_of_what_is_neither_free_nor_a_finger_stays(tmp_path):
    station = SimulationStation(_scenario(tmp_path, "object_friction: 0.3"))
    inspector, plant = station.scene_graph.model_inspector(), station.plant
    friction = {}
    for name in ("base", *FINGER_BODIES, "table", "panda_hand"):
        geometries = plant.GetCollisionGeometriesForBody(plant.GetBodyByName(name))
        properties = [inspector.GetProximityProperties(g) for g in geometries]
        coulomb = [p.GetProperty("material", "coulomb_friction") for p in properties]
        friction[name] = {c.static_friction() for c in coulomb}
    assert friction == {
        "base": {0.3}, "panda_leftfinger": {0.3}, "panda_rightfinger": {0.3},
        "table": {0.7}, "panda_hand": {0.8},
    }  # fmt: skip
