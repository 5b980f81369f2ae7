"""The whole thing in thirty lines, on a real robot: what is not in simulation.py is in the asking.

python diagrams/hardware.py "hand me the hammer"
"""

import sys

from pydrake.systems.analysis import Simulator

from tog_drake.executor import Phase
from tog_drake.hardware.connection import connect
from tog_drake.hardware.real_time import RealTime
from tog_drake.scenario import load_scenario
from tog_drake.visualization import draw_decision, make_meshcat

# A scenario says what is in the world and how each stage of the pipeline is set up.
scenario = load_scenario("panda_lcm")

# The station (drivers and camera) and the pipeline (from images to commands), connected.
meshcat = make_meshcat()
world = connect(scenario, meshcat=meshcat)

# A task is a sentence on an input port.
simulator = Simulator(world.diagram)
loop = RealTime(simulator, world, meshcat)
context = simulator.get_mutable_context()
world.diagram.GetInputPort("task").FixValue(context, " ".join(sys.argv[1:]) or "use the hammer")

# The executor looks at 1 s, decides, and moves; every stage's value can be looked at on its port.
loop.stand(world.pipeline.executor.look_time)
world.require_images()
mine = world.pipeline.GetMyContextFromRoot(context)
choice = world.pipeline.GetOutputPort("choice").Eval(mine)
motion = world.pipeline.GetOutputPort("motion").Eval(mine)
print(choice.reason)
draw_decision(meshcat, choice=choice, motion=motion)
if input("Move the arm? [y/N] ") == "y":
    loop.move(lambda: world.state(context).phase in (Phase.DONE, Phase.FAILED), longest=120.0)
    print(world.guarded(context).broken or "it moved")
world.close()
