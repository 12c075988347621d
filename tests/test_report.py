"""The page of a posterior: what is in it, that it is safe, and that a browser shows it."""

from __future__ import annotations

import base64
import dataclasses
import gc
import hashlib
import json
import os
from collections.abc import Callable, Iterator
from html.parser import HTMLParser
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from bnirl_ros import cli
from bnirl_ros.demonstrations.demonstration import Demonstration
from bnirl_ros.experiments.scenarios import PAPER_LOOP, shipped_demonstration
from bnirl_ros.inference.convergence import NOTHING_DRAWN
from bnirl_ros.inference.posterior import Posterior, infer
from bnirl_ros.inference.settings import Settings
from bnirl_ros.inference.summary import Summary, summarise
from bnirl_ros.maps import FeatureMap, GridMap
from bnirl_ros.mdp.actions import ACTION_NAMES
from bnirl_ros.views.colours import colour_of
from bnirl_ros.views.report import report_page, title_of
from browser_support import chromium, complaints

pytestmark = pytest.mark.timeout(180)

HOSTILE = (
    "</script><script>document.title = 'hurt'</script><img src=x onerror=\"hurt()\">"
    "<!--<script>]]>\u2028'`${hurt()}&lt;\\u003c$\\frac$"
)


class Page(HTMLParser):
    """A page as its elements, each (tag, attributes), and the texts in each kind of element."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.texts: list[tuple[str, str]] = []
        self._inside = ""
        self.feed(text)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))
        self._inside = tag

    def handle_endtag(self, tag: str) -> None:
        self._inside = ""

    def handle_data(self, data: str) -> None:
        self.texts.append((self._inside, data))

    def within(self, tag: str) -> list[str]:
        return [text for each, text in self.texts if each == tag]

    @property
    def data(self) -> dict[str, Any]:
        return json.loads(self.within("script")[0])

    @property
    def policy(self) -> dict[str, str]:
        """The content security policy, by directive."""
        (told,) = (
            str(attributes["content"])
            for tag, attributes in self.elements
            if tag == "meta" and attributes.get("http-equiv") == "Content-Security-Policy"
        )
        return dict(rule.strip().split(" ", 1) for rule in told.split(";"))


@dataclasses.dataclass(frozen=True)
class Told:
    """A posterior with all that makes a page of it."""

    posterior: Posterior
    summary: Summary
    grid_map: GridMap

    def page(self, title: str = "a walk") -> str:
        return report_page(self.posterior, self.summary, self.grid_map, title)


def told(demonstration: Demonstration, grid_map: GridMap, **settings: Any) -> Told:
    # So few draws that a candidate of a single one has more than one per cent.
    posterior = infer(demonstration, grid_map, Settings(sweeps=25, burn_in=5, **settings))
    return Told(posterior, summarise(posterior, grid_map), grid_map)


@pytest.fixture(scope="module", params=["sequential", "paper"])
def loop(request: pytest.FixtureRequest) -> Told:
    """The paper's loop, inferred with each model."""
    return told(shipped_demonstration(PAPER_LOOP), PAPER_LOOP.grid_map, model=request.param)


@pytest.fixture(scope="module")
def hostile() -> Told:
    """The paper's loop in rooms, with a frame and rooms whose names would like to be markup."""
    demonstration, grid_map = shipped_demonstration(PAPER_LOOP), PAPER_LOOP.grid_map
    height, width = grid_map.free.shape
    room = np.add.outer(np.arange(height) * 3 // height * 3, np.arange(width) * 3 // width)
    names = {(number,): f"{number} {HOSTILE}" for number in range(9)}
    features = FeatureMap(room[..., np.newaxis], np.ones_like(grid_map.free), names)
    return told(demonstration, dataclasses.replace(grid_map, features=features, frame_id=HOSTILE))


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    with chromium(tmp_path_factory.mktemp("browser")) as opened:
        yield opened


@pytest.fixture
def show(browser: Any, tmp_path: Path) -> Callable[[str], Any]:
    """Show a page to the browser."""

    def show_it(page: str) -> Any:
        file = tmp_path / "report.html"
        file.write_text(page, encoding="utf-8")
        browser.get(file.as_uri())
        return browser

    return show_it


def image_in(uri: str) -> np.ndarray:
    with Image.open(BytesIO(base64.b64decode(uri.partition("base64,")[2]))) as image:
        return np.asarray(image.convert("RGBA"))


def test_the_data_are_those_of_the_posterior(loop: Told) -> None:
    data = Page(loop.page()).data
    summary = loop.summary
    of_mode = [goal for goal in data["goals"] if goal["rank"]]
    assert [goal["rank"] for goal in of_mode] == [each.rank for each in summary.subgoals]
    assert [tuple(goal["cell"]) for goal in of_mode] == [each.cell for each in summary.subgoals]
    for goal in data["goals"]:
        x, y = goal["cell"]
        assert goal["probability"] == pytest.approx(summary.cell_probability[y, x], abs=1e-4)
    # All that the slider may show, those that are no subgoal of the mode among them.
    rows, columns = np.nonzero(summary.cell_probability >= 0.01)
    probable = set(zip(columns.tolist(), rows.tolist(), strict=True))
    assert probable <= {tuple(goal["cell"]) for goal in data["goals"]}
    assert len(data["goals"]) > len(of_mode)
    red, green, blue = (round(255 * part) for part in colour_of(2))
    assert data["colours"][2] == f"#{red:02x}{green:02x}{blue:02x}"
    assert np.array_equal(image_in(data["map"])[::-1, :, 3] == 0, loop.grid_map.free)


def test_observations_are_told_by_their_distinct_pairs(loop: Told) -> None:
    data = Page(loop.page()).data
    pairs, summary = data["pairs"], loop.summary
    columns = np.column_stack([pairs[name] for name in ("x", "y", "action", "rank")])
    episodes = [each["number"] for each in data["episodes"] for _ in range(each["count"])]
    told_again = np.column_stack([episodes, columns[data["seen"]]])
    assert np.array_equal(told_again, np.column_stack([summary.observations, summary.rank_of]))
    assert len(columns) < len(summary.observations)
    assert np.bincount(data["seen"]).tolist() == pairs["count"]
    # How sure the first observation's subgoal is, counted draw by draw.
    drawn = loop.posterior.draws.subgoal_of.reshape(-1, len(summary.observations))
    of_pair = np.flatnonzero(np.array(data["seen"]) == data["seen"][0])
    agreed = loop.posterior.mode.subgoal_of[of_pair] == drawn[:, of_pair]
    assert pairs["sure"][data["seen"][0]] == pytest.approx(agreed.mean(), abs=1e-3)


def test_traces_are_those_of_the_chains(loop: Told) -> None:
    traces = {trace["name"]: trace for trace in Page(loop.page()).data["traces"]}
    draws = loop.posterior.draws
    assert np.array(traces["log joint"]["chains"]) == pytest.approx(draws.log_joint, abs=0.01)
    distinct = [[len(set(each.tolist()) - {-1}) for each in chain] for chain in draws.subgoal_of]
    assert traces["number of subgoals"]["chains"] == distinct
    inferred = [each.name for each in loop.summary.parameters if each.inferred]
    assert set(inferred) <= set(traces)
    worst = max(float(trace["rhat"]) for trace in traces.values() if trace["rhat"] != "undefined")
    assert worst >= round(loop.summary.rhat or 0.0, 3)


def test_equal_posteriors_give_equal_pages(loop: Told) -> None:
    assert loop.page() == loop.page()


def test_the_page_is_one_file_that_forbids_any_network(loop: Told) -> None:
    text = loop.page()
    page = Page(text)
    policy = page.policy
    assert policy["default-src"] == "'none'"
    assert policy["img-src"] == "data:"
    assert set(policy) <= {
        *("default-src", "img-src", "script-src", "style-src", "base-uri", "form-action")
    }
    # Only what came with the page may run, and it is as it was when its hash was taken.
    for tag, rule in (("script", "script-src"), ("style", "style-src")):
        digest = hashlib.sha256(page.within(tag)[-1].encode()).digest()
        assert policy[rule] == f"'sha256-{base64.b64encode(digest).decode()}'"
    for _, attributes in page.elements:
        assert not {"src", "style", "srcset"} & set(attributes)
        assert not any(name.startswith("on") for name in attributes)
        assert (attributes.get("href") or "#").startswith("#")
    assert "://" not in text.replace("http://www.w3.org/2000/svg", "")  # a name, no address


def test_names_from_bags_stay_text(hostile: Told) -> None:
    page = Page(hostile.page(title=HOSTILE))
    harmless = Page(dataclasses.replace(hostile).page(title="a walk"))
    assert [tag for tag, _ in page.elements].count("script") == 2
    assert [tag for tag, _ in page.elements] == [tag for tag, _ in harmless.elements]
    assert "img" not in {tag for tag, _ in page.elements}
    assert page.within("h1")[0] == HOSTILE
    assert page.data["frame"] == HOSTILE
    assert page.data["goals"][0]["label"].endswith(HOSTILE)


def test_a_name_that_is_no_utf_8_is_written_all_the_same(loop: Told) -> None:
    name = os.fsdecode(b"drive \xff.mcap")
    assert "drive ?.mcap" in loop.page(title=name).encode("utf-8").decode("utf-8")


@pytest.mark.parametrize(
    ("paths", "title"),
    [
        (["logs/monday"], "monday"),
        (["-"], "standard input"),
        (["b.mcap", "a.csv", "c"], "b.mcap, a.csv, c"),
        (["a", "b", "c", "d"], "4 demonstrations"),
    ],
)
def test_a_title_names_few_and_counts_many(paths: list[str], title: str) -> None:
    assert title_of(list(map(Path, paths))) == title


def test_a_page_of_nothing_but_slips(loop: Told) -> None:
    nothing = dataclasses.replace(
        loop.summary,
        subgoals=(),
        visit_sequence=(),
        rank_of=np.zeros_like(loop.summary.rank_of),
        rank_of_candidate=np.zeros_like(loop.summary.rank_of_candidate),
        pursuits=(),
        unexplained=1.0,
        convergence=NOTHING_DRAWN,
    )
    page = dataclasses.replace(loop, summary=nothing).page()
    assert "No subgoal explains any of 299 observations in 5 episodes." in page
    assert "R-hat is undefined" in page


def test_a_page_of_a_long_demonstration_on_a_large_map_is_small(loop: Told) -> None:
    generator = np.random.default_rng(0)
    free = generator.random((100, 170)) > 0.1
    free = np.kron(free, np.ones((10, 10), dtype=bool))
    free[: loop.grid_map.free.shape[0], : loop.grid_map.free.shape[1]] = loop.grid_map.free
    rows = np.arange(20_000) % len(loop.summary.observations)
    observations = loop.summary.observations[rows]
    observations[:, 0] = np.arange(len(rows)) // 500
    demonstration = dataclasses.replace(
        loop.posterior.demonstration,
        episode=observations[:, 0],
        cells=observations[:, 1:3],
        action=observations[:, 3],
    )
    draws = dataclasses.replace(
        loop.posterior.draws,
        subgoal_of=loop.posterior.draws.subgoal_of[..., rows],
        partition_of=loop.posterior.draws.partition_of[..., rows],
    )
    long = Told(
        dataclasses.replace(loop.posterior, demonstration=demonstration, draws=draws),
        dataclasses.replace(
            loop.summary, observations=observations, rank_of=loop.summary.rank_of[rows]
        ),
        dataclasses.replace(loop.grid_map, free=free),
    )
    page = long.page()
    assert len(Page(page).data["seen"]) == 20_000
    assert len(page.encode()) < 1_000_000


def test_the_command_writes_it_beside_the_results(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bag = Path(__file__).resolve().parent.parent / "bags" / PAPER_LOOP.name
    arguments = ["infer", str(bag), "--sweeps", "60", "--burn-in", "20", "--out", str(tmp_path)]
    try:
        assert cli.main([*arguments, "--report"]) == 0
    finally:
        gc.unfreeze()
        gc.enable()
    files = ["posterior.npz", "report.html", "subgoals.json", "subgoals.png"]
    assert sorted(path.name for path in tmp_path.iterdir()) == files
    assert str(tmp_path / "report.html") in capsys.readouterr().out
    page = Page((tmp_path / "report.html").read_text(encoding="utf-8"))
    assert page.within("h1")[0] == PAPER_LOOP.name


# In a browser


def slide_to(browser: Any, percent: int) -> None:
    """Move the slider by its keys, as somebody without a mouse does."""
    from selenium.webdriver.common.keys import Keys

    slider = browser.find_element("id", "least")
    while (now := int(slider.get_property("value"))) != percent:
        slider.send_keys(
            (Keys.ARROW_LEFT if now > percent else Keys.ARROW_RIGHT) * abs(now - percent)
        )


def seen_in(browser: Any, selector: str) -> list[Any]:
    return [
        each for each in browser.find_elements("css selector", selector) if each.is_displayed()
    ]


def picture(browser: Any, canvas: str) -> str:
    return browser.execute_script(f"return document.getElementById('{canvas}').toDataURL()")


def test_a_browser_shows_it_and_the_slider_changes_what_is_shown(
    loop: Told, show: Callable[[str], Any]
) -> None:
    browser = show(loop.page())
    summary = loop.summary
    assert browser.execute_script("return document.documentElement.dataset.ready") == "true"
    assert len(seen_in(browser, ".marker")) == len(summary.subgoals)
    assert len(seen_in(browser, ".trace path[class^=stroke]")) >= 2 * summary.chains
    # A browser takes a script for done before the map, an image, is: wait for its colour.
    colours = """
        const canvas = document.getElementById("map");
        const bytes = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height).data;
        const found = new Set();
        for (let i = 0; i < bytes.length; i += 4) found.add(bytes.slice(i, i + 3).join());
        return [...found];
    """
    wanted = {",".join(str(round(255 * part)) for part in colour_of(rank)) for rank in (0, 1, 2)}
    if (summary.rank_of > 0).all():
        wanted.discard(",".join(str(round(255 * part)) for part in colour_of(0)))
    wanted.add("64,71,79")  # blocked
    wait_for(browser, lambda: wanted <= set(browser.execute_script(colours)))

    probable = Page(loop.page()).data["goals"]
    before = picture(browser, "map")
    for percent in (1, 100):
        slide_to(browser, percent)
        kept = [goal for goal in probable if goal["probability"] >= percent / 100 - 1e-9]
        of_mode = [goal for goal in kept if goal["rank"]]
        assert browser.find_element("id", "least-text").text == f"{percent / 100:.2f}"
        assert len(seen_in(browser, ".marker")) == len(of_mode)
        assert len(seen_in(browser, "#subgoals tr")) == len(of_mode)
        listed = min(len(kept) - len(of_mode), 30)
        assert len(browser.find_elements("css selector", "#others .rank")) == listed
        after = picture(browser, "map")
        assert after != before
        before = after
    assert complaints(browser) == []


def wait_for(browser: Any, condition: Callable[[], bool]) -> None:
    from selenium.webdriver.support.ui import WebDriverWait

    WebDriverWait(browser, 30).until(lambda _: condition())


def test_details_of_subgoals_and_observations_by_mouse_and_by_keys(
    loop: Told, show: Callable[[str], Any]
) -> None:
    from selenium.webdriver import ActionChains
    from selenium.webdriver.common.keys import Keys

    browser = show(loop.page())
    tip = browser.find_element("id", "tip")
    assert not tip.is_displayed()
    first = loop.summary.subgoals[0]
    marker = seen_in(browser, ".marker")[0]
    ActionChains(browser).move_to_element(marker).perform()
    assert tip.text.startswith(f"Subgoal 1: ({first.cell[0]}, {first.cell[1]})")
    assert f"{first.observations} observations" in tip.text
    timeline = browser.find_element("id", "timeline")
    timeline.send_keys(Keys.ARROW_RIGHT * 3)
    _, x, y, action = loop.summary.observations[2].tolist()
    words = browser.find_element("id", "told").text
    assert words.startswith("Episode 0, observation 3 of")
    assert f"{ACTION_NAMES[action]} in cell ({x}, {y}); for subgoal" in words
    # The cell in which an observation was made, where no marker lies on it.
    x, y = next(
        (x, y)
        for _, x, y, _ in loop.summary.observations.tolist()
        if all(max(abs(x - s.cell[0]), abs(y - s.cell[1])) > 2 for s in loop.summary.subgoals)
    )
    stage = browser.find_element("id", "stage")
    height, width = loop.grid_map.free.shape
    edge = min((stage.size["width"] - 24) / width, (stage.size["height"] - 24) / height)
    aside = [round((x - (width - 1) / 2) * edge), round(((height - 1) / 2 - y) * edge)]
    ActionChains(browser).move_to_element_with_offset(stage, *aside).perform()
    assert f"Cell ({x}, {y}): " in tip.text
    assert complaints(browser) == []


def test_a_browser_shows_hostile_names_as_text(hostile: Told, show: Callable[[str], Any]) -> None:
    browser = show(hostile.page(title=HOSTILE))
    assert browser.title == f"{HOSTILE}: subgoals"
    for shown in (("tag name", "h1"), ("id", "subgoals")):
        assert HOSTILE in browser.find_element(*shown).get_property("textContent")
    assert complaints(browser) == []
