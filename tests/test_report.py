import json
import re
import shutil
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from test_evaluation import POLICIES, results

from nl_env.comparison import PolicyInfo, compare
from nl_env.depth.metrics import METRIC_NAMES
from nl_env.report import write_report
from nl_env.tables import text_report


def infos():
    return [
        PolicyInfo(name, name.partition(":")[0], None, name != "random:0.4", True, name == "keyframe-rule")
        for name in POLICIES
    ]


@pytest.fixture(scope="module")
def comparison():
    return compare({"extrapolator": "approach <fast>"}, infos(), results(), np.random.default_rng(0))


@pytest.fixture(scope="module")
def folder(comparison, tmp_path_factory):
    folder = tmp_path_factory.mktemp("report")
    write_report(comparison, folder)
    return folder


def test_results_json_holds_every_number(comparison, folder):
    found = json.loads(
        (folder / "results.json").read_text(), parse_constant=pytest.fail
    )  # no NaN, no Infinity
    assert [policy["name"] for policy in found["policies"]] == list(POLICIES)
    for policy, summary in zip(found["policies"], comparison.summaries, strict=True):
        assert set(policy["held"]) == set(policy["produced"]) == set(METRIC_NAMES)
        assert policy["held"]["log_mae"]["mean"] == summary.held["log_mae"].mean
        assert np.mean(policy["per_sequence"]["error"]) == pytest.approx(summary.held["log_mae"].mean)
        assert policy["rate"]["min"] <= policy["rate"]["mean"] <= policy["rate"]["max"]
    assert found["frontier"][0]["family"] == "oracle"
    assert {curve["family"]: curve["regret"]["mean"] for curve in found["frontier"]}["periodic"] == 1.0
    assert found["rate_by_kind"]["scenario"]["always"]["rate"] == pytest.approx([50.0])
    assert found["policies"][0]["produced"]["log_mae"]["mean"] is None  # "never" produced nothing
    assert found["floor"]["rate"][0] == pytest.approx(10.0)
    assert np.all(np.diff(found["floor"]["rate"]) > 0)


def test_the_schema_document_names_every_field(folder):
    schema = Path(__file__).parents[1] / "docs" / "results-schema.md"
    documented = set(re.findall(r"`(\w+)`", schema.read_text(encoding="utf-8")))
    found = json.loads((folder / "results.json").read_text())
    curve = found["frontier"][0]
    fields = {*found, *found["sequences"][0], *found["policies"][0], *METRIC_NAMES}
    fields |= {*curve, *curve["matched"][0], *found["rate_by_kind"]["style"]["always"]}
    assert fields <= documented


def test_tables_show_the_same_numbers(comparison, folder):
    text = text_report(comparison).splitlines()
    assert len({len(line) for line in text}) == 1
    periodic = comparison.summaries[2].held["log_mae"].mean
    row = next(line for line in text if line.startswith("periodic:3"))
    assert f"{periodic:.4f}" in row.split()
    markdown = (folder / "table.md").read_text()
    regret = comparison.frontier["random"].regret.mean
    assert re.search(rf"\| random \| {regret:.3f} \|", markdown)
    assert re.search(rf"\| periodic:3 \|.*\| {periodic:.4f} \|", markdown)


@pytest.mark.parametrize("name", ["error_vs_rate", "frontier", "rate_vs_time", "rate_vs_speed"])
def test_figures_are_drawn(folder, name):
    image = np.asarray(Image.open(folder / f"{name}.png").convert("RGB")).astype(int)
    assert image.shape[1] > 800
    coloured = np.ptp(image, axis=2) > 60
    assert coloured.sum() > 1000  # curves, not only axes


def test_same_comparison_same_bytes(comparison, folder, tmp_path):
    write_report(comparison, tmp_path)
    for path in folder.iterdir():
        assert path.read_bytes() == (tmp_path / path.name).read_bytes(), path.name


def test_the_page_asks_for_nothing_outside_itself(folder):
    page = (folder / "report.html").read_text()
    assert not re.search(
        r"""(?:src|href)\s*=\s*["'](?!data:)|url\(|@import|https?://(?!www\.w3\.org)""", page
    )


@pytest.fixture
def browser(tmp_path):
    chromium, driver = shutil.which("chromium") or shutil.which("google-chrome"), shutil.which("chromedriver")
    if chromium is None or driver is None:
        pytest.skip("needs chromium and chromedriver")
    webdriver = pytest.importorskip("selenium.webdriver")
    options = webdriver.ChromeOptions()
    options.binary_location = chromium
    for argument in (
        "--headless",
        "--no-sandbox",
        "--disable-gpu",
        "--disable-quic",
        "--no-first-run",
        "--disable-background-networking",
        "--disable-component-update",
        "--disable-sync",
        "--window-size=1280,1600",
        f"--user-data-dir={tmp_path / 'profile'}",
    ):
        options.add_argument(argument)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    with webdriver.Chrome(options=options, service=webdriver.ChromeService(driver)) as browser:
        yield browser


CLICK_POINT = """
const [name, shiftKey] = arguments, svg = document.querySelector("#error-chart svg");
const family = name.split(":")[0], policy = results.policies.find(p => p.name === name);
const groups = [...document.querySelectorAll("#error-chart .legend button")].map(b => b.textContent);
const group = svg.querySelectorAll("g")[groups.indexOf(family)];
const box = group.querySelector("circle").getBoundingClientRect();
svg.dispatchEvent(new MouseEvent("click", {
  clientX: box.left + box.width / 2, clientY: box.top + box.height / 2, shiftKey, bubbles: true,
}));
"""


def wait_for(browser, condition):
    deadline = time.monotonic() + 20
    while not browser.execute_script(f"return {condition}"):
        assert time.monotonic() < deadline, f"never true: {condition}"
        time.sleep(0.05)


def test_the_page_works_in_a_browser(folder, browser):
    browser.get((folder / "report.html").as_uri())
    wait_for(browser, "document.body.dataset.ready === 'true'")
    slice_shown = "Number(document.getElementById('slider').value)"
    held = "document.getElementById('held-0').toDataURL()"

    first, before = browser.execute_script(f"return {slice_shown}"), browser.execute_script(f"return {held}")
    browser.find_element("id", "play").click()
    wait_for(browser, f"{slice_shown} > {first} + 5")
    wait_for(browser, f"{held} !== {json.dumps(before)}")
    browser.find_element("id", "play").click()
    stopped = browser.execute_script(f"return {slice_shown}")
    time.sleep(0.3)
    assert browser.execute_script(f"return {slice_shown}") == stopped

    # Policy B becomes "always": at any slice it holds that slice's own frame.
    browser.execute_script("const s = document.getElementById('policy-1'); s.value = 'always'; s.onchange()")
    assert "0 ms" in browser.find_element("id", "readout-1").text

    # So does a click on a point of the frontier, also one that is not in the table; with shift it goes to A.
    for name, shift, target in (("random:0.4", False, "policy-1"), ("periodic:3", True, "policy-0")):
        browser.execute_script(CLICK_POINT, name, shift)
        assert browser.execute_script(f"return document.getElementById('{target}').value") == name

    rows = browser.find_elements("css selector", "#table tbody tr")
    listed = [info.name + (" *" if info.privileged else "") for info in infos() if info.listed]
    assert [row.find_element("css selector", "td").text for row in rows] == listed
    families = browser.find_elements("css selector", "#regret-table tbody td:first-child")
    assert [cell.text for cell in families] == ["oracle", "periodic", "random", "keyframe-rule"]
    for view in browser.find_elements("css selector", "#views button"):
        view.click()
        assert browser.find_elements("css selector", "#error-chart circle")
        assert not browser.execute_script(
            "return document.querySelector('#error-chart').innerHTML.includes('NaN')"
        )
    assert [entry for entry in browser.get_log("browser") if entry["level"] != "INFO"] == []


def test_the_browser_would_report_a_broken_page(folder, browser, tmp_path):
    page = (folder / "report.html").read_text().replace("drawHeader();\ndrawRegrets();", "drawNothing();")
    broken = tmp_path / "broken.html"
    broken.write_text(page)
    browser.get(broken.as_uri())
    assert any(entry["level"] == "SEVERE" for entry in browser.get_log("browser"))


def test_a_page_without_frames_has_no_player(comparison, browser, tmp_path):
    sequences = tuple(replace(sequence, frames=None) for sequence in comparison.sequences)
    write_report(replace(comparison, sequences=sequences, shown=None), tmp_path)
    assert not (tmp_path / "rate_vs_time.png").exists()
    browser.get((tmp_path / "report.html").as_uri())
    wait_for(browser, "document.body.dataset.ready === 'true'")
    assert browser.find_elements("id", "player") == []
    assert browser.find_elements("css selector", "#error-chart circle")
    assert [entry for entry in browser.get_log("browser") if entry["level"] != "INFO"] == []
