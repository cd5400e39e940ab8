"""The page in a real browser: nothing fetched, nothing complained of, controls that change the plot, hostile texts."""

import json
import re
import shutil
from importlib.util import find_spec
from pathlib import Path

import pytest

import linksweep
from tests.sweep.outside import wait_until
from tests.sweep.report.test_page import evil_store
from tests.tiers import PATIENCE_S

__all__ = ["evil_store"]
CHROMIUM, DRIVER = shutil.which("chromium"), shutil.which("chromedriver")
NEEDS = pytest.mark.skipif(CHROMIUM is None or DRIVER is None, reason="needs chromium and chromedriver")
pytestmark = [pytest.mark.slow, NEEDS]
OPTIONS = ["--headless=new", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-sync"]
OPTIONS += ["--disable-dev-shm-usage", "--disable-background-networking", "--disable-component-update"]

# Elements in all shadow roots too, where BokehJS puts its own.
EVERYTHING = """
  const everything = (root) =>
    [...root.querySelectorAll("*")].flatMap((e) => [e, ...(e.shadowRoot ? everything(e.shadowRoot) : [])]);
"""


@pytest.fixture(scope="module")
def chromium(tmp_path_factory):
    pytest.importorskip("selenium")
    from selenium import webdriver
    from selenium.webdriver.chrome.service import Service

    options = webdriver.ChromeOptions()
    options.binary_location = CHROMIUM
    for option in (*OPTIONS, f"--user-data-dir={tmp_path_factory.mktemp('chromium')}"):
        options.add_argument(option)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
    driver = webdriver.Chrome(options=options, service=Service(DRIVER))
    yield driver
    driver.quit()


def empty_page(chromium, width, theme):
    size = {"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": width < 500}
    chromium.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    scheme = [{"name": "prefers-color-scheme", "value": theme}]
    chromium.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": "", "features": scheme})
    chromium.get("about:blank")
    for log in ("browser", "performance"):
        chromium.get_log(log)


@pytest.fixture
def show(chromium, tmp_path, sweep_here):
    """A function that opens the page about stores at a width and in a theme, and waits until all is drawn."""

    def open_page(stores, width=1200, theme="light"):
        path = tmp_path / "page.html"
        sweep_here("report", *stores, "-o", path, code=0)
        empty_page(chromium, width, theme)
        chromium.get(path.as_uri())
        wait_for_turn(chromium, 1)
        return chromium

    return open_page


def wait_for_turn(driver, turn):
    views = "[...document.querySelectorAll('[data-explorer]')]"
    script = f"return {views}.every((view) => Number(view.dataset.turn) >= arguments[0])"
    wait_until(lambda: driver.execute_script(script, turn), script)


def requests(driver):
    messages = [json.loads(entry["message"])["message"] for entry in driver.get_log("performance")]
    sent = [m["params"]["request"]["url"] for m in messages if m["method"] == "Network.requestWillBeSent"]
    sockets = [m["params"]["url"] for m in messages if m["method"] == "Network.webSocketCreated"]
    return sent + sockets


def complaints(driver):
    return [entry for entry in driver.get_log("browser") if entry["level"] not in ("INFO", "DEBUG")]


def turn(driver, act, *arguments):
    before = int(driver.find_element("css selector", "[data-explorer]").get_attribute("data-turn"))
    act(*arguments)
    wait_for_turn(driver, before + 1)


def choose(driver, name, value):
    from selenium.webdriver.support.ui import Select

    control = Select(driver.find_element("name", name))
    if control.first_selected_option.get_attribute("value") != value:
        turn(driver, control.select_by_value, value)


def drawn(driver):
    """Return what Bokeh draws in the only view: labels of axes, names in the legend, scale, and places of points."""
    script = """
      const plots = [...Bokeh.index.roots].map((view) => view.model).filter((model) => model.type === "Figure");
      const [plot] = plots;
      const points = plot.renderers.filter((r) => r.glyph.type === "Scatter" && r.glyph.size.value === 7);
      const legend = plot.below.find((part) => part.type === "Legend");
      return {
        x: plot.below.find((part) => part.type.endsWith("Axis")).axis_label,
        y: plot.left.find((part) => part.type.endsWith("Axis")).axis_label,
        scale: plot.y_scale.type,
        legend: legend ? legend.items.map((item) => item.label.value) : [],
        series: points.map((r) => [Array.from(r.data_source.data.x), Array.from(r.data_source.data.y)]),
        kept: [plots.length, Bokeh.documents.length],
      };
    """
    return driver.execute_script(script)


def pixels(driver):
    canvases = "everything(document.querySelector('.plot')).filter((e) => e.tagName === 'CANVAS')"
    return driver.execute_script(f"{EVERYTHING} return {canvases}.map((canvas) => canvas.toDataURL())")


def check_quiet(driver, width):
    """Refuse a page that asks for something from elsewhere, complains of something or is wider than its window."""
    assert [url for url in requests(driver) if not url.startswith(("file://", "data:"))] == []
    assert complaints(driver) == []
    assert driver.execute_script("return document.documentElement.scrollWidth") <= width


@pytest.mark.parametrize(("width", "theme"), [(1200, "light"), (375, "dark")])
def test_it_opens_from_a_file_without_network_and_complaint(show, store_of, width, theme):
    driver = show([store_of("quasars"), store_of("scatter")], width, theme)
    check_quiet(driver, width)
    background = driver.execute_script("return getComputedStyle(document.body).backgroundColor")
    assert (sum(map(int, re.findall(r"\d+", background)[:3])) > 400) == (theme == "light")
    driver.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": "print"})
    driver.execute_script("dispatchEvent(new Event('beforeprint')); document.body.style.width = '300px'")
    printed = driver.find_elements("css selector", ".plot > canvas")
    assert theme == "dark" or [0 < one.size["width"] <= 300 for one in printed] == [True, True]


def test_controls_change_the_plot(show, store_of):
    dataset = linksweep.open(store_of("quasars"))
    driver = show([store_of("quasars")])
    first, picture = drawn(driver), pixels(driver)
    assert (first["x"], first["y"], first["scale"]) == ("v_max [mag]", "sigma_spin [µas/yr]", "LogScale")
    assert first["legend"] == ["model = amex", "model = gaia", "predicted", "published", "one-sigma error"]
    for (x, y), model in zip(first["series"], ("amex", "gaia"), strict=True):
        assert x == dataset["v_max"].values.tolist()
        assert y == pytest.approx((1000.0 * dataset["sigma_spin"].sel(model=model)).values.tolist(), rel=1e-6)
    choose(driver, "x", "model")
    assert drawn(driver)["x"] == "model"
    assert pixels(driver) != picture
    choose(driver, "x", "v_max")
    choose(driver, "series", "")
    choose(driver, "fixed-model", "1")
    second = drawn(driver)
    gaia = 1000.0 * dataset["sigma_spin"].sel(model="gaia")
    assert second["series"][0][1] == pytest.approx(gaia.values.tolist(), rel=1e-6)
    assert second["kept"] == [1, 1]  # those before are gone
    choose(driver, "scale", "linear")
    sigma = driver.find_element("xpath", "//select[@name='quantity']/option[.='sigma']")
    choose(driver, "quantity", sigma.get_attribute("value"))
    choose(driver, "fixed-component", "5")
    third = drawn(driver)
    last = dataset["sigma"].isel(component=5).sel(model="gaia")
    assert (third["scale"], third["y"]) == ("LinearScale", "sigma(omega_z) [µas/yr]")
    assert third["series"][0][1] == pytest.approx((1000.0 * last).values.tolist(), rel=1e-6)
    address = driver.current_url  # in which a view stands
    nonsense = address.partition("#")[0] + "#explore-1=%7Bnonsense"
    for url, wanted in ((address, third), (nonsense, first)):
        driver.get("about:blank")
        driver.get(url)
        wait_for_turn(driver, 1)
        assert drawn(driver) == wanted
    assert complaints(driver) == []


def test_the_button_changes_the_theme_of_page_figures_and_view_and_foreign_scripts_do_not_run(show, store_of):
    driver = show([store_of("quasars")])
    style = "getComputedStyle(document.querySelector(s))"
    colours = f"return ['body', 'figure svg text', '.plot'].map((s) => {style}[s.endsWith('text') ? 'fill' : 'color'])"
    light, picture = driver.execute_script(colours), pixels(driver)
    turn(driver, driver.find_element("id", "theme").click)
    dark = driver.execute_script(colours)
    assert all(one != other for one, other in zip(light, dark, strict=True))
    assert pixels(driver) != picture
    turn(driver, driver.find_element("id", "theme").click)
    assert driver.execute_script(colours) == light
    # the policy stops what is not of the page: a script that got in does not run, and nothing can be fetched
    driver.execute_script("""
      const script = document.createElement("script");
      script.textContent = "window.owned = true";
      document.body.append(script);
    """)
    assert driver.execute_script("return window.owned") is None
    fetch = "fetch('http://127.0.0.1:9/').then(() => done('fetched'), () => done('refused'))"
    assert driver.execute_async_script(f"const done = arguments[0]; {fetch}") == "refused"
    assert any("Content Security Policy" in entry["message"] for entry in complaints(driver))


def test_hostile_texts_are_shown_as_text(show, evil_store):
    driver = show([evil_store], 375)
    assert driver.title.startswith("<script>window.owned = true</script>")
    text = driver.find_element("tag name", "body").text
    assert "<img src=x onerror='window.owned = true'>?" in text
    assert "</script><script>window.owned = true</script> is what failed" in text
    choose(driver, "series", "metal")
    choose(driver, "series", "")
    choose(driver, "x", "metal")
    assert drawn(driver)["x"] == "metal"
    assert driver.execute_script("return [document.images.length, window.owned]") == [0, None]
    check_quiet(driver, 375)


def rows_shown(driver, column=1):
    rows = "[...document.querySelector('#results-1 tbody').rows].filter((row) => row.offsetParent)"
    return driver.execute_script(f"return {rows}.map((row) => Number(row.cells[{column}].dataset.value))")


def enter(driver, name, text):
    from selenium.webdriver.common.keys import Keys

    turn(driver, driver.find_element("name", name).send_keys, text, Keys.TAB)
    return driver.switch_to.active_element.get_attribute("name")


def test_a_range_holds_for_map_and_table_and_can_be_gone_back_from(show, store_of):
    driver = show([store_of("quasars")])
    assert enter(driver, "from-v_max", "15") == "to-v_max"
    enter(driver, "to-v_max", "16.5")
    assert rows_shown(driver) == [15.0, 15.5, 16.0, 16.5] * 2
    choose(driver, "kind", "map")
    script = """
      const [plot] = [...Bokeh.index.roots].map((view) => view.model).filter((model) => model.type === "Figure");
      const {data} = plot.renderers.find((r) => r.glyph.type === "Quad").data_source;
      return [...data.left].map((left, i) => [left, data.right[i], data.number[i], data.alpha[i]]);
    """
    cells = driver.execute_script(script)
    values = 1000.0 * linksweep.open(store_of("quasars"))["sigma_spin"].transpose("model", "v_max").values
    assert [number for *_, number, _ in cells] == pytest.approx(values.ravel().tolist(), rel=1e-6)
    assert [(left + right) / 2.0 for left, right, _, alpha in cells if alpha == 1.0] == rows_shown(driver)
    choose(driver, "x", "model")
    turn(driver, driver.back)
    assert driver.execute_script(script) == cells
    turn(driver, driver.back)
    assert drawn(driver)["x"] == "v_max [mag]"
    turn(driver, driver.find_element("name", "all").click)
    assert (len(rows_shown(driver)), complaints(driver)) == (26, [])


def test_a_day_is_told_from_the_next_and_what_nobody_asked_for_is_not_missing(show, tmp_path):
    @linksweep.experiment(outputs=[linksweep.Output("flux", nan=True)])
    def lit(jd: float, kernel: str = "flat", gamma: float = 1.0):
        return {"flux": (gamma if gamma < 3.0 else float("inf")) * (jd - 2459999.0) if kernel == "steep" else 2.5}

    axes = {"kernel": ["flat", "steep"], "gamma": [1.0, 2.0, 3.0], "jd": [2460000.0 + 0.1 * i for i in range(11)]}
    study = {"experiment": lit, "axes": axes, "when": {"gamma": {"kernel": ["steep"]}}}
    linksweep.run(study, tmp_path / "lc.zarr", pool="serial")
    driver, status = show([tmp_path / "lc.zarr"]), "return document.querySelector('.status').textContent"
    enter(driver, "from-jd", "2460000.5")
    assert sorted(rows_shown(driver, 2)) == sorted([2460000.0 + 0.1 * i for i in range(5, 11)] * 4)
    for x, series, legend in (("jd", "gamma", ["no gamma"]), ("gamma", "kernel", ["kernel = flat", "kernel = steep"])):
        choose(driver, "x", x)
        choose(driver, "series", series)
        assert drawn(driver)["legend"] in (legend, [])
        assert "missing" not in driver.execute_script(status)
    choose(driver, "kind", "map")
    assert ("values are infinite" in driver.execute_script(status), complaints(driver)) == (True, [])


def test_the_two_colours_of_truth_values_are_named_and_a_constant_is_seen(show, tmp_path):
    axes = {"a": [1, 2, 3], "b": [1, 2]}
    linksweep.run(lambda a, b: {"kg": 2e30, "more": a > b}, tmp_path / "s.zarr", axes=axes, pool="serial")
    driver = show([tmp_path / "s.zarr"])
    plot = "[...Bokeh.index.roots].map((view) => view.model).find((model) => model.type === 'Figure')"
    ends = driver.execute_script(f"return [{plot}.y_range.start, {plot}.y_range.end]")
    assert ends == pytest.approx([1.8e30, 2.2e30])
    choose(driver, "quantity", "1")
    choose(driver, "kind", "map")
    bar = f"{plot}.right.find((part) => part.type === 'ColorBar')"
    script = f"return [[...{bar}.major_label_overrides.values()], {bar}.color_mapper.palette.length]"
    assert driver.execute_script(script) == [["False", "True"], 2]


def test_dragging_in_the_plot_chooses_a_range(show, store_of):
    from selenium.webdriver.common.action_chains import ActionChains

    driver = show([store_of("quasars")])
    plot = driver.find_element("css selector", ".plot")
    driver.execute_script("arguments[0].scrollIntoView({block: 'center'})", plot)
    hand = ActionChains(driver).move_to_element_with_offset(plot, -200, 0).click_and_hold()
    turn(driver, hand.move_by_offset(150, 0).move_by_offset(150, 0).release().perform)
    low, high = (float(driver.find_element("name", f"{end}-v_max").get_attribute("value")) for end in ("from", "to"))
    known = linksweep.open(store_of("quasars"))["v_max"].values
    assert set(rows_shown(driver)) == set(known[(known >= low) & (known <= high)]) < set(known)
    assert {low, high} < set(known)
    assert "ranges" in driver.current_url


def test_a_heading_sorts_by_value_and_pictures_and_tables_are_saved(show, store_of, tmp_path):
    driver = show([store_of("quasars")])
    driver.execute_cdp_cmd("Browser.setDownloadBehavior", {"behavior": "allow", "downloadPath": str(tmp_path)})
    driver.execute_script("document.querySelectorAll('details').forEach((part) => { part.open = true; })")
    heading = driver.find_element("xpath", "//table[1]//th[button[starts-with(., 'sigma_spin')]]")
    rows = "[...arguments[0].closest('table').tBodies[0].rows]"
    read = f"return {rows}.map((row) => Number(row.cells[arguments[0].cellIndex].dataset.value))"
    for descending in (False, True):
        heading.find_element("tag name", "button").click()
        values = driver.execute_script(read, heading)
        assert values == sorted(values, reverse=descending)
    for kind in ("csv", "svg", "png"):
        driver.execute_script("document.querySelector(arguments[0]).click()", f"button.{kind}")
        [result] = wait_until(lambda kind=kind: list(tmp_path.glob(f"quasars*.{kind}")), kind)
        assert result.stat().st_size > 500
    assert "light-dark" not in next(tmp_path.glob("*.svg")).read_text()
    assert next(tmp_path.glob("*.csv")).read_text().startswith("model,v_max [mag],sigma_spin [µas/yr],")


@pytest.mark.parametrize("theme", ["light", "dark"])
@pytest.mark.parametrize("names", [("quasars", "galaxies"), ("error-surface", "scatter", "icrf2-icrf3")])
def test_axe_finds_nothing(show, store_of, names, theme):
    axe = find_spec("axe_core_python")
    if axe is None:
        pytest.skip("needs axe-core-python")
    driver = show([store_of(name) for name in names], theme=theme)
    driver.set_script_timeout(PATIENCE_S)
    driver.execute_script(Path(axe.origin).with_name("axe.min.js").read_text(encoding="utf-8"))
    run = "axe.run(document, {resultTypes: ['violations']}).then((r) => done(r.violations.map((v) => v.id)))"
    assert driver.execute_async_script(f"const done = arguments[0]; {run}") == []
