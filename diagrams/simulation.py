"""The whole thing in thirty lines: build the Diagram, ask for a task, watch it in Meshcat.

python diagrams/simulation.py "hand me the hammer"
"""

import sys

from pydrake.systems.analysis import Simulator

from tog_drake.scenario import load_scenario
from tog_drake.visualization import draw_decision, make_meshcat
from tog_drake.world import build_world

# A scenario says what is in the world and how each stage of the pipeline is set up.
scenario = load_scenario("Hammer", "simulator_config: {target_realtime_rate: 1.0}")

# The station (robot and world) and the pipeline (from images to commands), connected.
meshcat = make_meshcat()
world = build_world(scenario, meshcat=meshcat)

# A task is a sentence on an input port.
simulator = Simulator(world.diagram)
simulator.set_target_realtime_rate(scenario.simulator_config.target_realtime_rate)
context = simulator.get_mutable_context()
world.diagram.GetInputPort("task").FixValue(context, " ".join(sys.argv[1:]) or "use the hammer")

# The executor looks at 1 s, decides, and moves; every stage's value can be looked at on its port.
simulator.AdvanceTo(world.pipeline.executor.look_time)
mine = world.pipeline.GetMyContextFromRoot(context)
choice = world.pipeline.GetOutputPort("choice").Eval(mine)
motion = world.pipeline.GetOutputPort("motion").Eval(mine)
print(choice.reason)
draw_decision(meshcat, choice=choice, motion=motion)
simulator.AdvanceTo(context.get_time() + motion.duration + 0.5)
