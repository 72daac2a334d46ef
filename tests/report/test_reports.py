"""The HTML reports of replay and diagnose: what they say, and that a browser shows them whole and asks for nothing."""

import hashlib
import re
import shutil
from collections.abc import Iterator
from datetime import UTC, datetime
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread
from typing import Any, NamedTuple

import numpy as np
import pytest
import yaml

import soilbus
from availability import unavailable
from soilbus.can.dbc_files import load_databases
from soilbus.cli.main import main
from soilbus.config.file import load_config, parse_config
from soilbus.offline.diagnose import Findings, diagnose_logs
from soilbus.offline.replay import replay
from soilbus.pipeline.result import WindowResult
from soilbus.report.page import Source
from soilbus.report.replay_pictures import TimeAxis, clock_text, dates
from soilbus.simulator.reference import TRACTOR
from soilbus.terra.entry_angle import entry_angle_for_load
from soilbus.terra.soil_laws import lumped_modulus
from soilbus.terra.wheel import WheelModel, WheelState, wheel_forces

pytest.importorskip("jinja2", reason="the extra `plots` is not installed")
pytest.importorskip("matplotlib", reason="the extra `plots` is not installed")

REPO = Path(__file__).resolve().parents[2]
FLAGS = (
    "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking",
    "--disable-component-update", "--disable-sync",
)  # fmt: skip
SECONDS = 30


class Made(NamedTuple):
    """A drive and its reports, with the windows and the findings of which they are made."""

    log: Path
    replay: Path
    diagnosis: Path
    results: list[WindowResult]
    findings: Findings


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Made:
    """Reports of a drive on which slipping wheels dig, and in the replay a second one that sees no ground speed."""
    folder = tmp_path_factory.mktemp("reports")
    log, deaf = folder / "drive.log", folder / "deaf.log"
    effect = "--effect=slip_sinkage=0.6"
    assert main(["simulate", "--duration", str(SECONDS), effect, "--start", "47.5", "8.7", "--log", str(log)]) == 0
    lines = log.read_text().splitlines(keepends=True)
    speed = next(m for m in load_databases(load_config(TRACTOR)).messages if m.name == "GroundBasedSpeedAndDistance")
    code = f"{speed.frame_id:08X}#"
    pause = [line for line in lines if code not in line or not 8.0 < float(line[1:18]) - 1.7e9 < 22.0]
    deaf.write_text("".join(pause))
    config, out = ["--config", str(TRACTOR)], (folder / "replay.html", folder / "diagnosis.html")
    results: list[WindowResult] = []
    found: list[Findings] = []

    def replayed(*arguments: Any, **more: Any) -> Iterator[WindowResult]:
        for result in replay(*arguments, **more):
            results.append(result)
            yield result

    def diagnosed(*arguments: Any, **more: Any) -> Findings:
        found.append(diagnose_logs(*arguments, **more))
        return found[-1]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("soilbus.cli.engineer.replay_logs", replayed)
        patch.setattr("soilbus.offline.diagnose.diagnose_logs", diagnosed)
        assert main(["replay", *config, str(log), str(deaf), "--report", str(out[0]), "--set", "estimator.hop=2"]) == 0
        assert main(["diagnose", *config, str(log), "--report", str(out[1])]) == 0
    return Made(log, *out, results, *found)


@pytest.fixture(scope="module")
def findings(made) -> Findings:
    return made.findings


@pytest.fixture(scope="module")
def results(made) -> list[WindowResult]:
    """Windows of the same drive twice, the second time without ground speed for a while."""
    return made.results


@pytest.fixture(scope="module")
def browser(tmp_path_factory) -> Iterator[Any]:
    variable = "SOILBUS_REQUIRE_BROWSER"
    chromium = shutil.which("chromium")
    if chromium is None:
        unavailable("no chromium on this machine", variable)
    try:
        from playwright.sync_api import sync_playwright
    except ImportError:
        unavailable("playwright is not installed", variable)
    with sync_playwright() as play:
        profile = tmp_path_factory.mktemp("profile")
        context = play.chromium.launch_persistent_context(
            profile, executable_path=chromium, headless=True, args=list(FLAGS)
        )
        yield context
        context.close()


class Opened(NamedTuple):
    """A page as a browser shows it: its width and the window's, errors, requests, ends of the first two pictures."""

    width: int
    window: int
    errors: list[str]
    requests: list[str]
    pair: list[float]
    shown: list[bool]


def opened(browser: Any, file: Path, width: int) -> Opened:
    tab = browser.new_page()
    tab.set_viewport_size({"width": width, "height": 800})
    errors: list[str] = []
    requests: list[str] = []
    tab.on("console", lambda message: errors.append(message.text))
    tab.on("pageerror", lambda error: errors.append(str(error)))
    tab.on("request", lambda request: requests.append(request.url))
    tab.goto(file.as_uri())
    pair = tab.evaluate(
        "[...document.querySelectorAll('.pair img')].slice(0, 2).map(i => i.getBoundingClientRect().bottom)"
    )
    tab.evaluate("document.querySelectorAll('details').forEach(d => d.open = true)")
    found = Opened(
        *tab.evaluate("[document.documentElement.scrollWidth, window.innerWidth]"), errors,
        [url for url in requests if not url.startswith("data:")], pair,
        tab.evaluate("[...document.images].map(i => i.complete && i.naturalWidth > 0)"),
    )  # fmt: skip
    tab.close()
    return found


@pytest.mark.parametrize("width", [390, 1280])
@pytest.mark.parametrize("report", ["replay", "diagnosis"])
def test_a_browser_shows_a_report_within_its_width_and_asks_for_nothing(browser, made, report, width):
    file = getattr(made, report)
    page = opened(browser, file, width)
    assert page.errors == []
    assert page.requests == [file.as_uri()]
    assert page.width <= page.window == width
    assert len(page.shown) >= 6
    assert all(page.shown)
    assert width < 1280 or max(page.pair) <= 800.0  # sentence and both pictures are on the first screen


def test_the_policy_of_a_report_stops_what_would_reach_outside(browser, made, tmp_path):
    """A browser announces a request that the policy stops, so a server counts those that come."""
    came: list[str] = []

    class Outside(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            came.append(self.path)
            self.send_error(404)

        def log_message(self, *_: object) -> None:
            pass

    with ThreadingHTTPServer(("127.0.0.1", 0), Outside) as server:
        Thread(target=server.serve_forever, daemon=True).start()
        image = f"<img src='http://127.0.0.1:{server.server_port}/x.png'><script>document.title = ''</script>"
        text = made.replay.read_text().replace("</main>", f"{image}</main>")
        stopped, free = tmp_path / "stopped.html", tmp_path / "free.html"
        stopped.write_text(text)
        free.write_text(re.sub("<meta http-equiv.*>", "", text))
        errors = opened(browser, stopped, 1280).errors
        assert came == []
        opened(browser, free, 1280)
        assert came == ["/x.png"]
        server.shutdown()
    assert len(errors) == 2
    assert all("Content Security Policy" in error for error in errors)


def test_a_diagnosis_says_what_is_missing_by_how_much_and_what_to_do(made, findings):
    page = made.diagnosis.read_text()
    (addition,) = findings.diagnosis.additions
    assert f"Missing from the model: {addition.effect.name}</h1>" in page.replace(" or stress_peak_shift", "")
    before, after = findings.diagnosis.gap_before.value, findings.diagnosis.gap_after.value
    assert f"off by {before**0.5:.2f} times the sensors’ noise, with {addition.effect.name} by {after**0.5:.2f}" in page
    assert f"soilbus diagnose --config {TRACTOR} {made.log} --model-out new.toml</pre>" in page
    assert addition.effect.physics in page
    for channel, unit in (("torque", "N m"), ("draft", "N"), ("sinkage", "mm")):
        pattern = rf"(Before|After): {channel} measured against modelled; typical difference [\d.]+ {unit}\."
        assert re.findall(pattern, page) == ["Before", "After"]
    assert page.index("<details><summary>All findings") < page.index("reading less model")


def test_modelled_readings_are_those_of_the_fitted_soil_at_the_measured_loads_and_slips(findings):
    fitted = findings.diagnosis.base
    series = next(s for s in fitted.held_out_series() if (s.channel, s.wheel) == ("torque", "RL"))
    problem, soil = fitted.checks[0].problem, fitted.fits[0].mode.posterior.soil
    wheel = problem.rig.wheels.index("RL")
    radius, width = problem.rig.radius[wheel], problem.rig.width[wheel]
    K_L, model = lumped_modulus(soil.k_c, soil.k_phi, width), findings.diagnosis.base.checks[0].problem.model
    torque = []
    for load, slip in zip(problem.load[:, wheel], problem.slip[:, wheel], strict=True):
        state = WheelState(0.3, slip, radius, width, K_L, soil.n, np.tan(soil.phi), soil.c, soil.K)
        angle = entry_angle_for_load(np.array([load]), state, model)
        torque.append(float(wheel_forces(state._replace(entry_angle=angle), model)[2][0]))
    assert isinstance(model, WheelModel)
    assert np.corrcoef(series.modelled, torque)[0, 1] > 0.99
    assert series.modelled == pytest.approx(np.array(torque), rel=0.08)
    assert np.std(series.modelled - torque) < 0.2 * np.std(series.measured)


def test_largest_draft_of_a_diagnosis_is_that_of_the_service_on_the_same_drive(findings, results):
    ((name, before, _),) = findings.largest_drafts()
    of_windows = [r.traversability.max_draft.value for r in results if r.log == name and r.traversability.max_draft]
    assert len(of_windows) > 5
    assert before.value == pytest.approx(np.median(of_windows), rel=0.1)


def test_a_curve_breaks_between_recordings_and_where_a_window_has_no_estimate(results):
    axis = TimeAxis(results, 2.0)
    curve = axis.curve(lambda r: None if r.bearing is None else r.bearing.value)
    assert {r.log for r in results} == {"drive.log", "deaf.log"}
    t, value = curve[np.isfinite(curve[:, 1])].T
    known = [r for r in results if r.bearing is not None]
    assert len(known) < len(results)
    assert value.tolist() == [r.bearing.value for r in known]
    assert (np.diff(t) > 0.0).all()
    broken = np.flatnonzero(~np.isfinite(curve[:, 1]))
    second = next(i for i, r in enumerate(known) if r.log == "deaf.log")
    begin, end = np.flatnonzero(np.isfinite(curve[:, 1]))[[second - 1, second]]
    assert ((broken > begin) & (broken < end)).any()
    lengths = {log: length for log, _, length in axis.segments(lambda r: r.log)}
    assert lengths == {log: pytest.approx(2.0 * sum(r.log == log for r in results)) for log in lengths}


def test_stamps_are_times_of_day_or_seconds(results):
    assert clock_text(1700000000.0) == "22:13:20"
    assert clock_text(12.5) == "12.5 s"
    assert dates(results) == "2023-11-14"


def test_the_foot_names_version_vehicle_configuration_date_and_how_to_cite(made):
    config = load_config(TRACTOR, ["vehicle.mass=2500"])
    source = Source(config, TRACTOR, ["vehicle.mass=2500"], [made.log], datetime(2026, 5, 4, 7, 30, tzinfo=UTC))
    foot = dict(source.rows())
    assert foot["soilbus"] == f"version {soilbus.__version__}"
    digest = hashlib.sha256(TRACTOR.read_bytes()).hexdigest()
    assert foot["Configuration"].startswith(f"{TRACTOR.name} (SHA-256 {digest[:8]}")
    assert foot["Configuration"].endswith("vehicle.mass=2500")
    assert foot["Vehicle"].startswith("2500 kg, wheelbase 1.95 m")
    assert "FL, FR: radius 0.5 m, width 0.26 m" in foot["Wheels"]
    assert foot["Made"] == "2026-05-04 07:30 UTC"
    page = made.diagnosis.read_text()
    for text in ("version ", "2300 kg", digest[:8]):
        assert text in page


def test_how_to_cite_is_that_of_the_citation_file(made):
    citation = yaml.safe_load((REPO / "CITATION.cff").read_text(encoding="utf-8"))
    (article,) = citation["references"]
    text = dict(Source(load_config(TRACTOR)).rows())["How to cite"]
    for part in (
        citation["title"], citation["authors"][0]["name"], article["title"], article["journal"], article["doi"],
        article["authors"][0]["family-names"], *(str(article[key]) for key in ("year", "volume", "issue", "start")),
    ):  # fmt: skip
        assert part in text


def test_a_crawler_and_a_rig_have_their_foot(tmp_path):
    tracked = dict(Source(load_config(REPO / "tests/field/tracked.toml")).rows())
    assert "1.6 m of track on the ground" in tracked["Wheels"]
    rig = {
        "wheel": [{"name": "rig", "radius": 0.3, "width": 0.2}],
        "table": {"wheel_load": "W", "slip": "s", "torque": "T"},
    }
    assert "Vehicle" not in dict(Source(parse_config(rig)).rows())
