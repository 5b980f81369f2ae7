"""The control panel: an episode gone through by hand, by a program and in a real browser."""

import functools
import json
import threading
import time

import numpy as np
from browser import browser, needs_browser
from seeing_server import see_and_answer
from vlm_server import KEY, KEY_VARIABLES, VlmServer

from tog_drake import control_panel
from tog_drake.control_panel import APPROVE, ASK, K_SLIDER, LOOK, NEXT, PROPOSE, RESET, RUN, STOP
from tog_drake.scenario import load_scenario
from tog_drake.selectors.strategies import PERMUTABLE, STRATEGIES
from tog_drake.selectors.vlm.selector import Vlm
from tog_drake.selectors.vlm.specification import read_specification
from tog_drake.visualization import make_meshcat

FAST = "{pipeline: {trajectory: {speed: 1.0, lift_speed: 0.5, hold_time: 2.05}}}"
BLANK = np.full((60, 80, 3), 255, np.uint8)
TASK = "hand me the hammer"


def make_panel(out, selector=None):
    scenario = load_scenario("Hammer", FAST, seed=0)
    scenario.pipeline.selector = selector or scenario.pipeline.selector
    return control_panel.ControlPanel(make_meshcat(), scenario, name="Hammer", task=TASK, out=out)


def test_a_person_chooses_otherwise_and_the_record_says_so_and_what_the_selector_had_said(tmp_path):
    panel = make_panel(tmp_path)
    panel.run([LOOK, PROPOSE, ASK, NEXT, NEXT, APPROVE, RUN])
    record = json.loads((tmp_path / "episode.json").read_text())
    assert record["outcome"] == "lifted", record["message"]
    assert record["by_hand"]["selector"]["part"] == "head"
    assert record["choice"]["index"] != record["by_hand"]["selector"]["index"]
    assert record["choice"]["reason"].startswith("A person chose")
    assert record["choice"]["planned_index"] == record["choice"]["index"]
    assert "chosen by a person" in (tmp_path / "report.html").read_text()


def test_nothing_moves_before_it_is_approved_and_a_later_choice_takes_the_approval_back(tmp_path):
    panel = make_panel(tmp_path)
    assert panel.run([ASK, RUN]) is None
    assert "nothing is approved yet" in panel.status
    assert panel.run([APPROVE, NEXT, RUN]) is None
    assert "nothing is approved yet" in panel.status
    assert not (tmp_path / "episode.json").exists()


def test_who_asks_again_has_the_selectors_choice_back(tmp_path):
    panel = make_panel(tmp_path)
    panel.run([ASK])
    said = panel.decision.choice
    panel.run([ASK, NEXT, ASK])
    assert panel.decision.choice.index == said.index
    assert not panel.decision.by_hand
    assert "head" in panel.status


def test_a_person_stops_the_arm_which_then_stands_and_that_is_recorded(tmp_path, monkeypatch):
    panel, looks = make_panel(tmp_path), iter(range(1000))
    monkeypatch.setattr(panel, "_new_click", lambda name: name == STOP and next(looks) == 40)
    episode = panel.run([APPROVE, RUN])
    assert (episode.record["outcome"], episode.record["message"]) == ("stopped", "the STOP button")
    positions = episode.recording.positions
    assert np.abs(positions[-1] - positions[0]).max() > 0.05  # it had begun to move
    station = panel._world.station
    context = station.plant.GetMyContextFromRoot(panel._context)
    assert np.abs(station.plant.GetVelocities(context)[:7]).max() < 0.01


def test_another_seed_is_another_scene_and_another_k_other_candidates(tmp_path):
    panel = make_panel(tmp_path)
    panel.run([PROPOSE])
    seen = panel.decision.view.rgb
    panel.run([PROPOSE, RESET, PROPOSE])
    assert panel.scenario.random_seed == 1
    assert not np.array_equal(panel.decision.view.rgb, seen)
    panel.scenario.pipeline.candidates.k = 3
    panel.run([PROPOSE])
    assert len(panel.decision.candidates) == 3


def test_a_slider_that_is_moved_asks_for_other_candidates_or_in_another_way(tmp_path, monkeypatch):
    selector = Vlm(model=read_specification("openai:gpt-5@http://localhost:9/v1"), strategy="gsi")
    panel = make_panel(tmp_path, selector)
    seen = []

    def a_person():
        yield panel.advance("candidates")
        yield panel.meshcat.SetSliderValue(K_SLIDER, 3)
        seen.append(len(panel.decision.candidates))
        yield panel.meshcat.SetSliderValue(K_SLIDER, 0)
        seen.append(panel.scenario.pipeline.candidates.k)
        yield panel.meshcat.SetSliderValue(panel._strategy_slider, 5)
        seen.append(selector.strategy)
        yield panel.end()

    person = a_person()  # acts while the panel waits for a click
    monkeypatch.setattr(control_panel.time, "sleep", lambda seconds: next(person))
    assert panel.run() is None
    assert seen == [3, "auto", "cpg"]


def test_a_strategy_is_offered_only_where_it_can_be_asked_by(tmp_path):
    model, prompt = read_specification("openai:gpt-5@http://localhost:9/v1"), tmp_path / "mine.j2"
    prompt.write_text("{{ task | quoted }}")
    for selector, offered in (
        (Vlm("cpg", model=model), list(STRATEGIES)),
        (Vlm("gsi", model=model, votes=2), list(PERMUTABLE)),
        (Vlm("cpg", prompt=str(prompt), model=model), []),
        (None, []),
    ):
        assert make_panel(tmp_path, selector)._strategies == offered


def test_who_presses_ctrl_c_has_ended_it_and_keeps_the_last_episode(tmp_path):
    def presses():
        yield from (APPROVE, RUN)
        raise KeyboardInterrupt

    panel = make_panel(tmp_path)
    episode = panel.run(presses())
    assert episode.record["outcome"] == "lifted"
    assert (tmp_path / "report.html").exists()


def test_what_a_model_was_sent_and_said_is_on_the_board_and_is_kept_where_a_person_overrules_it(
    tmp_path, monkeypatch
):
    monkeypatch.setenv(KEY_VARIABLES["openai"], KEY)
    boards = []
    monkeypatch.setattr(control_panel, "board_image", lambda *shown: boards.append(shown) or BLANK)
    with VlmServer(functools.partial(see_and_answer, family="pixels")) as server:
        model = read_specification(server.specification("openai"))
        panel = make_panel(tmp_path, Vlm(model=model, strategy="gsi"))
        panel.run([ASK])
        (exchange,) = panel.decision.choice.exchanges
        picture, words = boards[-1]
        np.testing.assert_array_equal(picture, exchange.images[0])
        assert exchange.answer in words[1]
        panel.run([ASK, NEXT, APPROVE, RUN])
    record = json.loads((tmp_path / "episode.json").read_text())
    assert record["by_hand"]["selector"]["index"] != record["choice"]["index"]
    assert [each["answer"] for each in record["vlm"]["exchanges"]] == [exchange.answer]


@needs_browser
def test_in_a_browser_buttons_lead_from_a_look_to_a_lifted_hammer(tmp_path):
    panel = make_panel(tmp_path)

    def click(window, name):
        buttons = "[...document.querySelectorAll('.cr.function')]"
        found = f"{buttons}.find(e => e.textContent.includes({json.dumps(name)}))"
        window.wait_for(found)
        window.do(f"{found}.querySelector('.property-name').click()")

    def slide(window, name, value):
        sliders = "[...document.querySelectorAll('.cr.number')]"
        found = f"{sliders}.find(e => e.textContent.includes({json.dumps(name)}))"
        window.do(
            f"const box = {found}.querySelector('input'); box.value = '{value}';"
            "box.dispatchEvent(new Event('change')); box.blur()"
        )

    def until(condition):
        end = time.monotonic() + 100
        while not condition() and time.monotonic() < end:
            time.sleep(0.05)
        assert condition(), panel.status

    def person():
        try:
            with browser(800, 600) as window:
                go_through(window)
        finally:
            panel.end()

    def go_through(window):
        window.open_url(url)
        click(window, LOOK)
        until(lambda: panel.decision.cloud is not None)
        window.do("document.querySelector('.close-button').click()")
        click(window, PROPOSE)
        until(lambda: panel.decision.candidates is not None)
        click(window, "by hand: red")
        until(lambda: panel.decision.by_hand)
        slide(window, K_SLIDER, 4)
        until(lambda: panel.scenario.pipeline.candidates.k == 4)
        click(window, ASK)
        until(lambda: panel.decision.choice is not None and not panel.decision.by_hand)
        click(window, APPROVE)
        until(lambda: panel.decision.motion is not None)
        click(window, RUN)
        until((tmp_path / "episode.json").exists)
        window.screenshot(tmp_path / "panel.png")

    url = panel.meshcat.web_url()  # Meshcat obeys the main thread alone
    thread = threading.Thread(target=person)
    thread.start()
    episode = panel.run()
    thread.join()
    assert episode.record["outcome"] == "lifted", episode.record["message"]
    assert episode.record["by_hand"] is None
    assert episode.record["counts"]["candidates"] == 4
    assert (tmp_path / "panel.png").stat().st_size > 10_000
