"""What the view that is shown decides: two cases, a model that points at what it sees, three ways.

    python tests/benchmarks/bench_views.py [SEEDS [FOLDER]]
    python tests/benchmarks/bench_views.py rows FOLDER   # tog eval views, into FOLDER

Ways: the wrist camera's view; the least ambiguous of all cameras' (`--view coverage`), the grasps
being the same; and further looks with the wrist camera alone (`--look active`). In FOLDER, for
every episode, the picture that was shown with the place that was pointed at.
"""

import subprocess
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

import cv2
from pointing_model import point_and_answer
from rich.console import Console
from rich.table import Table
from vlm_server import VlmServer

from tog_drake.episode import run_episode
from tog_drake.scenario import load_scenario
from tog_drake.selectors.vlm.specification import read_specification
from tog_drake.vlm_record import exchanges_of

CASES = {
    "MugHandleHidden": "drink from the mug",
    "BottleFromAbove": "pick up the bottle by its label",
}
WAYS = {
    "hand": "",
    "coverage": "view_selection: {scorer: !Coverage {}}",
    "active": "look: !Active {}, cloud: {fuse: false}, view_selection: {scorer: !Coverage {}}",
}


def episode(case: str, way: str, seed: int, specification: str):
    """Runs one; returns it with what it says."""
    scenario = load_scenario(case, f"pipeline: {{{WAYS[way]}}}" if WAYS[way] else None, seed=seed)
    if way == "active":
        scenario.cameras = {"wrist": scenario.cameras["wrist"]}
    vlm = load_scenario(case, "pipeline: {selector: !Vlm {strategy: cpg}}").pipeline.selector
    vlm.model = read_specification(specification, profile=None)
    scenario.pipeline.selector = vlm
    return run_episode(scenario, name=case, task=CASES[case])


def draw(found, path: Path) -> None:
    """Writes what the model was shown, and the place that it pointed at."""
    for asked in exchanges_of(found.decision)[-1:]:
        picture = asked.images[-1][..., ::-1].copy()
        for u, v in asked.points.values():
            cv2.circle(picture, (round(u), round(v)), 9, (255, 255, 255), 4)
            cv2.circle(picture, (round(u), round(v)), 9, (0, 0, 0), 2)
        cv2.imwrite(str(path), picture)


def main(seeds: int = 5, folder: str | None = None) -> None:
    table = Table("case", "way", "seed", "shown", "score", "held", "task", "lifted", "both")
    totals: dict[tuple[str, str], list[int]] = {}
    with VlmServer(point_and_answer, key=None) as server:
        specification = server.specification("openai")
        for case in CASES:
            for way in WAYS:
                for seed in range(seeds):
                    found = episode(case, way, seed, specification)
                    r = found.record
                    seen = r["view_selection"] or {}
                    held = " ".join(f"{p} {s:.2f}" for p, s in r["held"].items() if s > 0.005)
                    row = (seen.get("camera", "wrist"), _score(seen), held or r["outcome"])
                    said = (r["task_compliance"], r["grasp_success"], r["combined_success"])
                    table.add_row(case, way, str(seed), *row, *map(str, said))
                    total = totals.setdefault((case, way), [0, 0, 0, 0])
                    for i, good in enumerate((True, *said)):
                        total[i] += bool(good)
                    if folder is not None:
                        Path(folder).mkdir(parents=True, exist_ok=True)
                        draw(found, Path(folder) / f"{case}_{way}_{seed}.png")
    console = Console(width=120)
    console.print(table)
    for (case, way), (n, task, grasp, both) in totals.items():
        console.print(f"{case:16} {way:9} task {task}/{n}  grasp {grasp}/{n}  both {both}/{n}")


def _score(seen) -> str:
    score = seen.get("scores", {}).get(seen.get("camera"))
    return "-" if score is None else f"{score:.2f}"


def rows(folder: str) -> None:
    """Runs the suite of both cases: what ``tog report`` makes of hand and least ambiguous view."""
    with VlmServer(point_and_answer, key=None) as server:
        command = [
            sys.executable,
            "-m",
            "tog_drake.cli",
            "eval",
            "views",
            "--views",
            "hand,coverage",
        ]
        asked = ["--vlm", server.specification("openai"), "--strategies", "cpg"]
        subprocess.run(
            [*command, "--selectors", "geometric,vlm", *asked, "--out", folder], check=True
        )


if __name__ == "__main__" and sys.argv[1:2] == ["rows"]:
    rows(sys.argv[2])
elif __name__ == "__main__":
    main(*(f(a) for f, a in zip((int, str), sys.argv[1:], strict=False)))
