"""Lines of a benchmark's journal, and folders of runs, as `tog eval` leaves them."""

import json

from tog_drake.benchmark.journal import EPISODES, PICTURES, RUN, SCHEMA


def make_exchange(answer="2", *, seconds=2.0, cost=0.001, replayed=None, **changes):
    return {
        "prompt": "cpg/1", "text": "Which?\n[image 1]", "marks": {"1": 12, "2": 4}, "key": "0a",
        "points": {}, "answer": answer, "status": "ok", "message": "", "model": "m-1",
        "seconds": seconds, "tokens": {"input": 100, "output": 10}, "cost": cost,
        "replayed": replayed, **changes,
    }  # fmt: skip


def make_vlm(exchanges, *, status="ok", fallback=None):
    return {
        "strategy": "cpg", "rendering": "marked", "model": "openai:m", "seed": 0,
        "status": status, "fallback": fallback, "exchanges": exchanges,
    }  # fmt: skip


def make_line(number=0, outcome="lifted", *, complies=True, exchanges=(), judge=None, **changes):
    """A line of an episode that held the handle, which the task allows where it ``complies``.

    ``changes`` are of the cell where it has such a field, of the record otherwise.
    """
    cell = {
        "name": f"episode-{number}", "number": number, "tasks": 1, "method": "oracle",
        "proposer": None, "k": None, "selector": "oracle", "strategy": None, "vlm": None,
        "view": None,
        "scenario": "Hammer", "object": "hammer", "seed": 0, "task": "use the hammer",
        "category": "use", "beyond": None,
    }  # fmt: skip
    of_cell = {key: changes.pop(key) for key in list(changes) if key in cell}
    cell |= of_cell
    lifted = outcome == "lifted"
    held = {"handle": 1.0} if lifted else {}
    record = {
        "schema": "tog_drake/episode/1", "version": "0.1.0", "task": cell["task"],
        "object": cell["object"], "scenario": cell["scenario"], "seed": cell["seed"],
        "proposer": {"kind": "antipodal"}, "selector": {"kind": cell["selector"]},
        "counts": {"points": 2000, "proposed": 100, "feasible": 60, "candidates": 6},
        "rejected": {"no_ik": 30, "hidden": 10, "no_lift": 0},
        "choice": {"index": 4, "planned_index": 4, "part": "handle", "reason": "It fits.",
                   "status": "ok", "pixel": None, "pointed": {}, "score": 0.5, "width": 0.03},
        "vlm": make_vlm(list(exchanges)) if exchanges else None,
        "attempts": [{"exchanges": list(exchanges)}],
        "outcome": outcome, "message": None, "grasp_success": lifted,
        "task_compliance": lifted and complies, "combined_success": lifted and complies,
        "strict_success": lifted, "held": held, "collisions": {},
        "chosen_closes_on": {"handle": 1.0}, "closes_on": {"handle": 1.0},
        "allowed": ["handle"] if complies else ["head"],
        "motion": {"duration": 8.0, "phases": {}, "note": "optimised, attempt 1"},
        "seconds": {"decide": 1.0, "execute": 4.0},
    } | changes  # fmt: skip
    return {"cell": cell, "record": record, "judge": judge}


def write_run(folder, lines, **config):
    """Writes a run of these lines; returns its folder."""
    methods = list(dict.fromkeys(line["cell"]["method"] for line in lines))
    (folder / PICTURES).mkdir(parents=True, exist_ok=True)
    asked = {
        "schema": SCHEMA, "suite": "builtin", "methods": methods, "seeds": 1, "noise": False,
        "version": "0.1.0",
    } | config  # fmt: skip
    (folder / RUN).write_text(json.dumps(asked))
    (folder / EPISODES).write_text("".join(json.dumps(line) + "\n" for line in lines))
    return folder
