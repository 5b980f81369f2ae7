import csv
import gzip
import html
import io
import json
import re
import shlex

import numpy as np
import pytest
import typer
from browser import ENTER, ESCAPE, TAB, browser, needs_browser
from command import refused, tog
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from run_folder import make_exchange, make_line, write_run

from tog_drake.benchmark import gallery
from tog_drake.benchmark.figures import candidate_figure
from tog_drake.benchmark.gallery import Pictures, Replays
from tog_drake.benchmark.journal import EPISODES, differences, read_run
from tog_drake.benchmark.report import command, write_benchmark_report
from tog_drake.benchmark.sheets import Share, make_sheet
from tog_drake.benchmark.success_sheets import main_sheet, published_share, scene_sheet
from tog_drake.benchmark.table_files import csv_text, latex_text, markdown_text
from tog_drake.benchmark_commands import command_words
from tog_drake.cli import app
from tog_drake.errors import InputError

HOSTILE = "</script><script>alert(1)</script><img src=x onerror=alert(2)> \u202egnorw {{ 7*7 }}"


def picture(path, value=200, size=(480, 640)):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.full((*size, 3), value, np.uint8)).save(path)
    return path


def some_lines():
    """Two methods on three trials; one asks a model."""
    told = make_exchange("Mark 2, the handle.")
    return [
        *(make_line(i, seed=i, task=t) for i, t in enumerate(("use it", "hold it", "lift it"))),
        make_line(3, method="vlm cpg m", selector="vlm", strategy="cpg", vlm="m", exchanges=[told]),
        make_line(4, "slipped", seed=1, task="hold it", method="vlm cpg m", selector="vlm",
                  strategy="cpg", vlm="m", object="mug", exchanges=[make_exchange("Mark 1.")]),
        make_line(5, "no_choice", seed=2, task="lift it", method="vlm cpg m", selector="vlm",
                  strategy="cpg", vlm="m", chosen_closes_on=None, choice=None, motion=None,
                  message="no number in the answer",
                  exchanges=[make_exchange(None, status="unreadable")]),
    ]  # fmt: skip


def run_of(folder, lines=None, **config):
    lines = some_lines() if lines is None else lines
    write_run(folder, lines, **config)
    for line in lines:
        of = folder / "episodes" / line["cell"]["name"]
        picture(of / "view.jpg", 10 * line["cell"]["number"])
        if line["record"]["vlm"]:
            picture(of / "sent-1.png", 77)
    return folder


def page_of(folder, *more):
    write_benchmark_report([folder, *more], folder / "out")
    return folder / "out" / "report.html"


def data_of(page):
    (block,) = re.findall(r'<script type="application/json" id="data">(.*?)</script>',
                          page.read_text(), flags=re.S)  # fmt: skip
    return json.loads(block)


def test_the_methods_stand_beside_what_the_paper_published():
    sheet = main_sheet(some_lines())
    rows = {row[0]: dict(zip(sheet.columns, row, strict=True)) for row in sheet.rows}
    ours, best = rows["vlm cpg m"], rows["Best score (published)"]
    assert (ours["n"], str(ours["Grasp and task"])) == (3, "0.333 [0.06, 0.79]")
    assert ours["Failures"] == "1 slipped, 1 no_choice (ok 1)"
    assert str(best["Grasp"]).startswith("0.754 [0.63, 0.8") and best["Task, as chosen"] is None
    assert rows["CPG with view selection Gemini (published)"]["Grasp"] is None
    assert sheet.published == 3


def test_a_published_rate_has_an_interval_where_a_count_of_the_trials_gives_it():
    assert published_share(0.754, 57).of == "43/57"
    assert published_share(0.796, 57) == Share(0.796)  # 45/57 is 0.789, 46/57 is 0.807
    assert published_share(None, 57) is None


def test_the_scenes_of_several_objects_stand_side_by_side(tmp_path):
    runs = [
        read_run(write_run(tmp_path / suite, [make_line(0), make_line(1, outcome, seed=1)],
                           suite=suite))
        for suite, outcome in (("tools", "lifted"), ("kitchen", "empty"))
    ]  # fmt: skip
    sheet = scene_sheet(runs)
    assert sheet.columns == ("Method", "Kitchen", "Tools", "Together")
    assert [cell.of for cell in sheet.rows[0][1:]] == ["1/2", "2/2", "3/4"]
    assert sheet.rows[1] == ("Real robot (published)", None, None, Share(0.7))
    assert scene_sheet(runs[:1]) is None


def test_a_scene_that_was_run_twice_stands_with_the_methods_of_both_or_is_refused(tmp_path):
    def of(name, suite, method):
        return read_run(write_run(tmp_path / name, [make_line(0, method=method)], suite=suite))

    one, other = of("a", "tools", "random"), of("b", "tools", "vlm")
    sheet = scene_sheet([one, other, of("c", "kitchen", "random")])
    assert [row[0] for row in sheet.rows[:2]] == ["random", "vlm"]
    assert sheet.rows[0][3].of == "2/2"
    assert sheet.rows[1][3] is None  # it is not of the same scenes
    with pytest.raises(InputError, match="second run of tools"):
        scene_sheet([one, of("d", "tools", "random")])


def test_the_figure_has_a_mark_for_each_k_and_joins_the_numbers_only():
    lines = [
        make_line(i, outcome, k=k, method=f"oracle k={k}", seed=i)
        for i, (k, outcome) in enumerate([("auto", "lifted"), ("10", "empty"), ("2", "lifted")])
    ]
    figure = candidate_figure(lines)
    assert [k for k, _ in figure["ks"]] == ["2", "10", "auto"]
    (series,) = figure["panels"][2]["series"]
    ends = [(mark["low"] > mark["y"] or mark["y"] > mark["high"]) for mark in series["marks"]]
    assert len(ends) == 3 and series["line"].count(",") == 2
    top, bottom = figure["frame"][2:]
    assert [mark["y"] for mark in series["marks"]] == [top, bottom, top]
    assert figure["chosen"] == [("oracle", [("6", 1, 1.0)])]
    assert candidate_figure(some_lines()) is None


NASTY = "=1+1|a\\b_{x}$%&#~^<i>\n\u202e``"


def test_no_cell_of_the_csv_is_a_formula_and_each_row_is_whole():
    lines = [make_line(0, method=NASTY, object="@cmd", task="+1", scenario="-2")]
    rows = list(csv.DictReader(io.StringIO(csv_text({"=run": lines}))))
    assert [row["by"] for row in rows] == ["category"] * 2 + ["scenario", "object", "task"]
    assert {row["method"][:3] for row in rows} == {"'=1"}
    assert [row["group"] for row in rows] == ["use", "all", "'-2", "'@cmd", "'+1"]
    assert {row["run"] for row in rows} == {"'=run"}
    assert (rows[0]["both"], rows[0]["both_successes"], rows[0]["failures"]) == ("1.0", "1", "")
    assert "\u202e" not in csv_text({"r": lines})


def test_what_was_in_view_stands_in_every_file(tmp_path):
    selections = {
        "hand": {"camera": "wrist", "candidates_visible": {"wrist": 2}},
        "coverage": {"camera": "side_1", "candidates_visible": {"wrist": 2, "side_1": 5}},
    }
    lines = [
        make_line(i, method=f"oracle, view: {view}", view=view, view_selection=selection)
        for i, (view, selection) in enumerate(selections.items())
    ]
    page = page_of(run_of(tmp_path, lines))
    rows = list(csv.DictReader((page.parent / "tables.csv").open()))
    assert {
        (row["method"], row["candidates"], row["hand_shows"], row["shows"], row["other_view"])
        for row in rows
    } == {("oracle, view: hand", "6.0", "2.0", "2.0", "0"),
          ("oracle, view: coverage", "6.0", "2.0", "5.0", "1")}  # fmt: skip
    title = "The hand's view and the least ambiguous one"
    for name in (page.name, "tables.md", "tables.tex"):
        assert title in html.unescape((page.parent / name).read_text()), name


def test_markdown_and_latex_show_whatever_there_is_as_text():
    sheet = make_sheet("x", "A & B", ("n_1", "%"), [(NASTY, Share(0.5, 0.1, 0.9)), ("1", None)])
    assert "\n| \\=1" not in markdown_text({"r": [sheet]})
    (row,) = [x for x in markdown_text({"r": [sheet]}).splitlines() if x.startswith("| =1")]
    assert row == (r"| =1+1\|a\\b\_\{x\}$%&amp;\#\~^&lt;i> \\u202e\`\` | 0.500 \[0.10, 0.90\] |")
    said = latex_text({"r": [sheet]})
    assert r"=1+1\textbar{}a\textbackslash{}b\_\{x\}\$\%\&\#\textasciitilde{}" in said
    assert r"\caption{r: A \& B. }" in said and r"n\_1 & \% \\" in said
    assert said.count(r"\toprule") == said.count(r"\bottomrule") == 1


@given(st.text(max_size=40))
def test_any_text_stays_in_its_cell(text):
    sheet = make_sheet("x", text, ("a", "b"), [(text, 1)])
    (row,) = [x for x in latex_text({text: [sheet]}).splitlines() if x.endswith(r" & 1 \\")]
    assert len(re.findall(r"(?<!\\)&", row)) == 1
    assert not re.search(r"(?<!\\)[%$#]", row.replace(r"$\kappa$", "").replace(
        r"$\times$", "").replace(r"$^\circ$", ""))  # fmt: skip
    table = markdown_text({text: [sheet]}).split("\n\n", 2)[2].strip().splitlines()
    assert len(table) == 3
    assert all(len(re.findall(r"(?<!\\)(?:\\\\)*\|", line)) == 3 for line in table)


def test_the_page_tells_what_was_found_and_how_to_find_it_again(tmp_path):
    page = page_of(run_of(tmp_path, suite="household", seeds=3)).read_text()
    for said in ("Grasping by task: household", "6 tasks, 6 episodes, 2 methods", "no_choice",
                 "CPG Gemini (published)", "Two methods on the same trials", "<dd>3</dd>",
                 "Questions to a model", "$0.0010"):  # fmt: skip
        assert said in page, said
    assert (tmp_path / "out" / "tables.md").read_text().startswith("# household\n")
    assert "By scenario" not in page  # of one scenario nothing is to be told apart


def config_of(folder):
    config = json.loads((folder / "run.json").read_text())
    return config.pop("command"), config


def begun(folder, *words):
    """Begins a run of no episodes; returns what its ``run.json`` says."""
    done = tog(*words, "--limit", 0, "--workers", 1, "--out", folder)
    assert done.status == 0, done.err
    return config_of(folder)


def test_the_command_on_the_page_runs_the_same_again(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "my suite.yaml").write_text(
        "groups: [{objects: [mug], tasks: [{category: use, task: 'use the {object}'}]}]"
    )
    model = "openai:any@http://127.0.0.1:9/v1"
    text = "# what is said over several lines\npipeline:\n  candidates: {k_max: 5}\n"
    asked = ["eval", "my suite.yaml", "--selectors", "random,vlm", "--strategies", "gsi,gmi",
             "--vlm", model, "--vlm", "openai:other@http://127.0.0.1:9/v1", "--proposers",
             "antipodal", "--k", "2,auto", "--profile", "pixels", "--rendering", "paper",
             "--votes", 2, "--fallback", "geometric", "--deadline", 9.5, "--seeds", 2, "--noise",
             "--scenario-text", text, "--judge", f"vlm:{model}"]  # fmt: skip
    words, config = begun(tmp_path / "a", *asked)
    assert config["scenario_text"] == text
    page = html.unescape(page_of(tmp_path / "a").read_text())
    (pasted,) = re.findall(r'<pre class="said"><code>(.*?)</code>', page, flags=re.S)
    assert pasted == command(read_run(tmp_path / "a"))
    assert shlex.split(pasted) == words == ["tog", *map(str, asked)]
    assert begun(tmp_path / "b", *shlex.split(pasted)[1:]) == (words, config)


def test_the_command_names_the_weights_and_is_not_what_tells_two_runs_apart(tmp_path):
    tmp_path.joinpath("released.pt").write_bytes(b"weights")
    eval_ = typer.main.get_command(app).commands["eval"]
    words = ["builtin", "--checkpoint", str(tmp_path / "released.pt"), "--out", "x", "--fresh"]
    context = eval_.make_context("eval", list(words))
    assert command_words(context) == ["tog", "eval", *words[:3]]
    assert differences({"command": ["a"], "seeds": 1}, {"command": ["b"], "seeds": 1}) == []


def test_a_run_from_before_there_was_a_command_has_none_on_its_page(tmp_path):
    assert command(read_run(run_of(tmp_path))) == ""
    assert "<code>" not in page_of(tmp_path).read_text()


def test_what_is_written_does_not_depend_on_the_order_in_which_episodes_ended(tmp_path):
    run_of(tmp_path)
    write_benchmark_report([tmp_path], tmp_path / "a")
    lines = (tmp_path / EPISODES).read_text().splitlines(keepends=True)
    (tmp_path / EPISODES).write_text("".join(lines[::-1]))
    write_benchmark_report([tmp_path], tmp_path / "b")
    for name in ("report.html", "tables.csv", "tables.md", "tables.tex"):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()


def test_whatever_a_model_or_a_user_said_is_inert(tmp_path):
    said = make_exchange(HOSTILE, text=HOSTILE, message=HOSTILE, prompt=HOSTILE, status=HOSTILE)
    fields = ("method", "scenario", "object", "task", "category", "outcome", "message", "strategy")
    everywhere = dict.fromkeys(fields, HOSTILE)
    choice = {"index": 1, "planned_index": 2, "part": HOSTILE, "reason": HOSTILE}
    judge = {"model": HOSTILE, "complies": None, "status": HOSTILE, "cost": None, "seconds": 1.0}
    line = make_line(0, exchanges=[said], choice=choice, held={HOSTILE: 1.0}, allowed=[HOSTILE],
                     chosen_closes_on={HOSTILE: 1.0}, judge=judge, vlm=HOSTILE,
                     **everywhere)  # fmt: skip
    page = page_of(run_of(tmp_path / "run", [line], suite=HOSTILE, version=HOSTILE))
    plain = page_of(run_of(tmp_path / "plain"))
    text = page.read_text()
    assert text.count("<script") == plain.read_text().count("<script") == 2
    assert "<img" not in text and "\u202e" not in text and "{{ 7*7 }}" in text
    (card,) = data_of(page)["cards"]
    assert card["task"].startswith("</script><script>") and "\\u202e" in card["task"]


def test_the_page_asks_nobody_for_anything(tmp_path):
    text = page_of(run_of(tmp_path)).read_text()
    assert "default-src data: blob:" in text
    assert not re.findall(r"""(?:src|href)=["'](?!data:)""", text)
    assert not re.search("https?:", text) and "@import" not in text and "url(" not in text


def test_a_picture_is_carried_once_and_small(tmp_path):
    page = page_of(run_of(tmp_path))
    data = data_of(page)
    views = {card["view"] for card in data["cards"]}
    sent = {key for card in data["cards"] for key in card["sent"]}
    assert (len(views), len(sent), len(data["pictures"])) == (6, 1, 7)
    assert {tuple(p["size"]) for p in data["pictures"].values()} == {(640, 480)}


def test_pictures_that_are_too_many_get_smaller_and_then_fewer(tmp_path, monkeypatch):
    random = np.random.default_rng(0)
    pictures = Pictures()
    keys = []
    for i in range(4):
        path = tmp_path / f"{i}.png"
        Image.fromarray(random.integers(0, 256, (240, 320, 3), np.uint8)).save(path)
        keys.append(pictures.add(path))
    whole = sum(len(p["data"]) for p in pictures.encoded().values())
    monkeypatch.setattr(gallery, "MAX_PICTURES", whole - 1)
    smaller = pictures.encoded()
    assert list(smaller) == keys
    assert sum(len(p["data"]) for p in smaller.values()) < whole
    monkeypatch.setattr(gallery, "MAX_PICTURES", whole // 6)
    fewer = pictures.encoded()
    assert 0 < len(fewer) < 4 and list(fewer) == keys[: len(fewer)]
    assert sum(len(p["data"]) for p in fewer.values()) <= whole // 6


def test_what_is_no_picture_and_what_lies_elsewhere_is_left_out(tmp_path):
    picture(tmp_path / "view.jpg")
    lines = [make_line(0, name=".."), make_line(1, name="../.."), make_line(2, name="broken")]
    run = write_run(tmp_path / "run", lines)
    for name, content in (("view.jpg", b"\xff\xd8no"), ("replay.html.gz", b"no gzip")):
        (run / "episodes" / "broken").mkdir(exist_ok=True)
        (run / "episodes" / "broken" / name).write_bytes(content)
    page = page_of(run)
    data = data_of(page)
    assert (data["pictures"], data["replays"]) == ({}, {})
    assert [card["view"] for card in data["cards"]][:2] == [None, None]
    assert "1 pictures and 1 replays are left out" in page.read_text()


def unpack(packed):
    import base64

    return gzip.decompress(base64.b64decode(packed)).decode()


def test_replays_are_carried_whole_and_the_viewer_once(tmp_path, monkeypatch):
    viewer = "<p>viewer</p>" + "ä" * 5000
    pages = [viewer + "é one", viewer + "è two"]  # they part within a character
    replays = Replays()
    keys = []
    for i, page in enumerate(pages):
        (tmp_path / f"{i}.gz").write_bytes(gzip.compress(page.encode()))
        keys.append(replays.add(tmp_path / f"{i}.gz"))
    begin, rest = replays.packed()
    bytes_of = [gzip.decompress(gallery.base64.b64decode(x)) for x in (begin, *rest.values())]
    assert [(bytes_of[0] + part).decode() for part in bytes_of[1:]] == pages
    assert list(rest) == keys and max(map(len, bytes_of[1:])) < 20
    monkeypatch.setattr(gallery, "MAX_REPLAYS", len(rest[keys[0]]))
    assert list(replays.packed()[1]) == keys[:1]


def test_a_run_of_the_papers_size_fits_into_fifteen_megabytes(tmp_path):
    lines = [
        make_line(i, seed=i, method=f"vlm {i % 4}", selector="vlm",
                  exchanges=[make_exchange("x" * 1500, text="y" * 3000)] * 2)
        for i in range(4 * 57)
    ]  # fmt: skip
    words = page_of(write_run(tmp_path, lines)).stat().st_size
    assert words + gallery.MAX_PICTURES < 15e6


def test_report_writes_page_and_tables_and_refuses_what_is_no_run(tmp_path):
    run_of(tmp_path / "run")
    done = tog("report", tmp_path / "run")
    assert done.status == 0, done.err
    assert done.out.count("written: ") == 4
    assert (tmp_path / "run" / "report.html").is_file()
    refused(tog("report", tmp_path / "none"), "holds no run", "tog eval")


@pytest.fixture(scope="module")
def run_with_a_replay(tmp_path_factory):
    run = run_of(tmp_path_factory.mktemp("runs") / "run", some_lines())
    scene = "<title>scene</title><script>document.title = 'played'</script>"
    (run / "episodes" / "episode-0" / "replay.html.gz").write_bytes(gzip.compress(scene.encode()))
    return run


CARDS = "[...document.querySelectorAll('.episode')].map(card => card.innerText)"


def choose(window, name, value):
    window.do(
        f"const field = document.querySelector('[name=\"{name}\"]'); field.value = {value!r};"
        "field.dispatchEvent(new Event('input', {bubbles: true}));"
    )


@needs_browser
def test_in_a_browser_the_gallery_is_filtered_and_a_card_opens(run_with_a_replay):
    page = page_of(run_with_a_replay)
    with browser() as window:
        window.open(page)
        assert window.do("return document.getElementById('count').textContent") == "6 of 6 cards"
        assert window.do("return document.querySelectorAll('.episode img').length") == 0
        window.do("document.querySelector('.gallery').scrollIntoView()")
        window.wait_for("document.querySelector('.episode img')?.complete")
        choose(window, "Method", "vlm cpg m")
        assert len(window.do(f"return {CARDS}")) == 3
        choose(window, "Outcome", "slipped")
        (card,) = window.do(f"return {CARDS}")
        assert "hold it" in card and "✗ slipped" in card and "mug" in card
        choose(window, "Outcome", "")
        choose(window, "search", "2, the HANDLE")  # in an answer
        assert window.do("return document.getElementById('count').textContent") == "1 of 6 cards"
        choose(window, "Method", "oracle")
        assert window.do(f"return {CARDS}") == []
        choose(window, "search", "")
        choose(window, "Task compliance", "task obeyed")
        assert len(window.do(f"return {CARDS}")) == 3

        window.do("document.querySelector('[name=search]').focus()")
        window.press(TAB, ENTER)  # the first card, by keyboard alone
        opened = window.wait_for("document.querySelector('dialog[open]')?.innerText")
        assert "“use it”" in opened and "handle 100%" in opened and "Play the replay" in opened
        window.press(TAB, ENTER)
        framed = window.wait_for("document.querySelector('dialog iframe')?.srcdoc")
        assert framed.startswith("<title>scene</title>")
        window.do("document.querySelector('dialog .close').focus()")
        window.press(ESCAPE)
        assert window.wait_for("!document.querySelector('dialog[open]')")
        assert window.do("return document.activeElement.className") == "episode"
        assert window.complaints() == []


@needs_browser
def test_in_a_browser_hostile_text_stays_text_and_a_phone_scrolls_no_page_sideways(tmp_path):
    said = make_exchange(HOSTILE * 5, text=HOSTILE)
    lines = [
        make_line(i, task=HOSTILE, object="a_name_without_any_space_" * 5, method=f"{i}" + HOSTILE,
                  k=f"{i + 2}", seed=i, exchanges=[said])
        for i in range(3)
    ]  # fmt: skip
    page = page_of(run_of(tmp_path, lines, suite="s" * 100))
    wide = "return document.documentElement.scrollWidth"
    for width in (380, 1280):
        with browser(width) as window:
            window.open(page)
            window.do("document.querySelector('.gallery').scrollIntoView()")
            window.wait_for("document.querySelector('.episode img')")
            assert window.do(wide) <= width
            window.do("document.querySelectorAll('details').forEach(d => { d.open = true; })")
            tables = "[...document.querySelectorAll('.scroll')]"
            beyond = f"{tables}.filter(s => s.scrollWidth > s.clientWidth)"
            if width < 600:
                assert window.do(f"return {beyond}.map(s => s.ariaLabel)") == []
            window.do("document.querySelectorAll('details').forEach(item => item.open = true)")
            assert window.do(wide) <= width
            window.do("document.querySelector('.episode').click()")
            shown = window.wait_for("document.querySelector('dialog[open]')")
            assert shown
            assert not window.do(
                "const d = document.querySelector('dialog'); return d.scrollWidth > d.clientWidth"
            )
            assert "<script>alert(1)" in window.do(
                "return document.querySelector('dialog').innerText"
            )
            assert window.do("return document.querySelectorAll('script').length") == 2
            assert window.complaints() == []
