"""The programs and pages that users copy."""

import sys

from tog_drake.resources import resource_dir


def test_the_thirty_line_program_lifts_a_hammer(monkeypatch, capsys):
    program = resource_dir("diagrams") / "simulation.py"
    assert sum(bool(line.strip()) for line in program.read_text().splitlines()) <= 40
    # As fast as it goes: real time is for people who watch.
    source = program.read_text().replace("target_realtime_rate: 1.0", "target_realtime_rate: 0.0")
    namespace = {"__name__": "__main__"}
    monkeypatch.setattr(sys, "argv", ["simulation.py", "hand", "me", "the", "hammer"])
    exec(compile(source, str(program), "exec"), namespace)
    assert "head" in capsys.readouterr().out
    world, context = namespace["world"], namespace["context"]
    poses = world.station.GetOutputPort("cheat.body_poses").Eval(
        world.station.GetMyContextFromRoot(context)
    )
    assert poses[world.station.plant.GetBodyByName("base").index()].translation()[2] > 0.10
