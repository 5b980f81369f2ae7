"""How fast a scanned object is simulated in the hand: ``pytest tests/benchmarks/bench_scans.py``.

One episode for each imported object of the suite, with its first task there and a grasp chosen by
the oracle; ``-k hammer`` takes some of them. Rates are simulated to elapsed time; those of the
process' own time (cpu) are distorted little by other work on the machine.
"""

import time
from typing import NamedTuple

import numpy as np
import pytest

from tog_drake import episode
from tog_drake.assets.library import asset_names
from tog_drake.benchmark.suite import SCENARIO, load_suite
from tog_drake.judge import Judge
from tog_drake.scenario import load_scenario
from tog_drake.selectors.oracle import Oracle

TASKS = {trial.object: trial.task for trial in reversed(load_suite("tog29").trials)}
"""Of each object the first."""
OBJECTS = [name for name in asset_names() if name in TASKS]

COUNTED = 10  # looks between two that count the faces of contact, which costs time itself


class Look(NamedTuple):
    """What the clocks and the contacts said when the judge looked."""

    moved: float  # [s] since the motion began
    wall: float  # [s]
    cpu: float  # [s]
    judging: float  # [s] of cpu that the judge took
    surfaces: float  # of contact, wherever; NaN where they were not counted
    faces: float  # of these: as many contact points


@pytest.fixture
def looks(monkeypatch):
    """The looks that the judge of an episode takes."""
    found = []

    class Stopwatch(Judge):
        def observe(self, context, state):
            wall, cpu = time.perf_counter(), time.process_time()
            super().observe(context, state)
            judging = time.process_time() - cpu
            count = faces = np.nan
            if len(found) % COUNTED == 0:
                contacts = self._station.GetOutputPort("cheat.contact_results").Eval(context)
                count = contacts.num_hydroelastic_contacts()
                infos = (contacts.hydroelastic_contact_info(i) for i in range(count))
                faces = sum(info.contact_surface().num_faces() for info in infos)
            found.append(Look(self.samples[-1].time, wall, cpu, judging, count, faces))

    monkeypatch.setattr(episode, "Judge", Stopwatch)
    return found


@pytest.fixture(scope="module")
def rows(request):
    """Of each object the numbers that ``_shown`` shows; the medians are printed at the end."""
    found = []
    yield found
    if found:
        with request.config.pluginmanager.getplugin("capturemanager").global_and_fixture_disabled():
            print(f"\nmedian of {len(found)}:", _shown(np.median(found, axis=0)))


def _shown(row):
    in_hand, cpu, whole, judge, surfaces, faces = row
    return (
        f"in hand {in_hand:.2f} (cpu {cpu:.2f}, of it the judge {100 * judge:.0f} %), "
        f"whole {whole:.2f}; {surfaces:.1f} surfaces of {faces:.0f} faces"
    )


@pytest.mark.skipif(not OBJECTS, reason="no object of the suite is imported (TOG_ASSETS)")
@pytest.mark.parametrize("name", OBJECTS)
def test_rate_with_the_object_in_the_hand(name, looks, rows, capsys):
    scenario = load_scenario(SCENARIO)
    scenario.asset = name
    scenario.pipeline.selector = Oracle()
    record = episode.run_episode(scenario, name=SCENARIO, task=TASKS[name], target=name).record
    if record["motion"] is None:
        pytest.skip(f"{name}: {record['outcome']}")
    held = [look for look in looks if look.moved >= record["motion"]["phases"]["lift"]]
    first, last = held[0], held[-1]
    simulated, cpu = last.moved - first.moved, last.cpu - first.cpu
    rows.append(
        (
            simulated / (last.wall - first.wall),
            simulated / cpu,
            record["sim"]["real_time_rate"],
            sum(look.judging for look in held[:-1]) / cpu,
            np.nanmean([look.surfaces for look in held]),
            np.nanmean([look.faces for look in held]),
        )
    )
    turned = "" if record["turned"] is None else f", turned {record['turned']:.1f} deg"
    with capsys.disabled():
        print(f"\n{name}: {last.wall - first.wall:.2f} s, {_shown(rows[-1])}")
        print(f"  {record['outcome']}{turned}", end="")
    assert simulated > 0
