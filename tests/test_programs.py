"""The programs and pages that users copy."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

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


@pytest.mark.skipif(not Path("/proc/self/status").is_file(), reason="Linux tells the peak there")
def test_a_run_needs_less_than_a_gigabyte_and_no_torch(tmp_path):
    program = f"""
import json, re, sys
from tog_drake.cli import main
sys.argv = ["tog", "run", "--scenario", "Hammer", "--task", "hand me the hammer",
            "--out", {str(tmp_path / "out")!r}]
try:
    main()
finally:
    # Not getrusage: that counts the process which started this one, too.
    peak = re.search(r"VmHWM:\\s+(\\d+) kB", open("/proc/self/status").read())
    print(json.dumps([int(peak[1]) * 1024, "torch" in sys.modules]))
"""
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stderr
    peak, torch_is_loaded = json.loads(done.stdout.splitlines()[-1])
    assert peak < 1e9  # [byte]
    assert not torch_is_loaded
