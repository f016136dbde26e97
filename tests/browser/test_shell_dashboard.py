"""An existing client of the spooler dialect, used as its user would: Spark's shell-dashboard.

The client is third-party code and no part of this project. The environment variable
``TOOLPOST_SHELL_DASHBOARD`` names the folder that holds it, built at its commit 23f11bd; its
pages are served from an origin of their own, and call ``http://localhost:9000``, which is fixed
in them. With ``TOOLPOST_SCREENSHOTS`` set, pictures of each part are left in that folder.

The simulated core answers after 80 ms: this client ignores reports that are less than 50 ms
younger than its question, and asks on and on until a later one comes.
"""

import os
import re
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Browser, Error, Locator, Page, expect

from tests.browser.watching import StaticSite, Watch, port_taken
from tests.harness import Server

pytestmark = pytest.mark.browser

FOLDER = "TOOLPOST_SHELL_DASHBOARD"
SCREENSHOTS = "TOOLPOST_SCREENSHOTS"
PORT = 9000
ANSWER_DELAY = 0.08  # seconds
COMMAND_TIME = 0.05  # seconds
PATIENCE = 15_000  # milliseconds, for whatever the page shows in the end

CONFIG = """\
[server]
listen = "127.0.0.1:0"

[machines.edm]
driver = "spark"
link = "sim"
listen = ["127.0.0.1:{port}"]

[machines.edm.sim]
answer_delay = {answer_delay}
command_time = {command_time}
"""


def sent_by(server: Server) -> list[str]:
    """Every line that went to the machine so far."""
    return [payload for direction, payload in server.comm_log() if direction == "down"]


def commands(lines: list[str]) -> list[str]:
    """Those lines that the machine queues: no signals."""
    return [line for line in lines if line[:1] not in "?!"]


class Dashboard:
    """The page, in the words of what a person sees on it."""

    def __init__(self, page: Page, watch: Watch) -> None:
        self.page = page
        self.watch = watch
        self.status = page.locator(".status-info")

    def widget(self, title: str) -> Locator:
        heading = self.page.get_by_role("heading", name=title, exact=True)
        return self.page.locator(".widget", has=heading)

    def button(self, widget: str, name: str) -> Locator:
        return self.widget(widget).get_by_role("button", name=name, exact=True)

    def rows(self, widget: str) -> Locator:
        return self.widget(widget).locator("tbody tr")

    def row(self, widget: str, key: str) -> Locator:
        """The table row whose first cell is ``key``."""
        cell = self.page.get_by_role("cell", name=key, exact=True)
        return self.rows(widget).filter(has=cell)

    def expect_idle(self, timeout: float = PATIENCE) -> None:
        expect(self.status).to_have_text("🔵 idle", timeout=timeout)

    def expect_busy(self, text: str | re.Pattern[str] = "🟠 busy") -> None:
        expect(self.status).to_contain_text(text, timeout=PATIENCE)

    def expect_position(self, text: str | re.Pattern[str]) -> None:
        expect(self.widget("Jog")).to_contain_text(text, timeout=PATIENCE)

    def position(self) -> dict[str, float]:
        """The machine coordinates on display, in mm and degrees."""
        shown = re.compile(r"\(machine\) X(\S+) Y(\S+) Z(\S+) C(\S+)")
        self.expect_position(shown)
        match = shown.search(self.widget("Jog").inner_text())
        assert match
        return dict(zip("XYZC", map(float, match.groups()), strict=True))

    def execute(self, text: str) -> None:
        """Sends a batch by Manual Command, once the machine is idle."""
        self.widget("Manual Command").locator("textarea").fill(text)
        self.button("Manual Command", "EXECUTE").click(timeout=PATIENCE)

    def run(self, text: str) -> None:
        """The same, and waits until every line was sent and done."""
        lines = [line for line in text.splitlines() if line.strip()]
        with self.page.expect_response(
            lambda response: (
                response.url.endswith("/write-line")
                and response.request.post_data_json == {"line": lines[-1]}
            )
        ):
            self.execute(text)
        self.until_idle()

    def until_idle(self) -> None:
        """Waits for an idle status that was asked for from now on."""
        self.page.wait_for_timeout(250)
        self.expect_idle()

    def paste_job(self, lines: list[str]) -> None:
        self.page.evaluate("text => navigator.clipboard.writeText(text)", "\n".join(lines))
        self.button("Add Job", "PASTE FROM CLIPBOARD").click()
        kept = [line.strip() for line in lines if line.strip()]
        expect(self.widget("Add Job")).to_contain_text(f"{len(kept)} lines ({kept[0][:20]}...)")
        self.button("Add Job", "EXECUTE").click(timeout=PATIENCE)

    def job_statuses(self) -> list[str]:
        """The first column of the job list, after a REFRESH; the newest job is the first."""
        with self.page.expect_response(answer_to("/list-jobs")):
            self.button("Job List", "REFRESH").click()
        self.watch.settle(100)
        return [row.split("\t")[0].strip() for row in self.rows("Job List").all_inner_texts()]

    def expect_newest_job(self, status: str) -> None:
        eventually(lambda: self.job_statuses()[0], status)

    def errors(self) -> list[str]:
        """The rows of the error list, after a REFRESH; the newest is the first."""
        with self.page.expect_response(answer_to("/get-ps", tag="error")):
            self.button("Errors", "REFRESH").click()
        self.watch.settle(100)
        return self.rows("Errors").all_inner_texts()

    def refresh_settings(self) -> None:
        with self.page.expect_response(answer_to("/get-ps", tag="stg"), timeout=PATIENCE):
            self.button("Settings", "REFRESH").click(timeout=PATIENCE)
        expect(self.widget("Settings")).to_contain_text("Showing ", timeout=PATIENCE)
        self.watch.settle(200)

    def edit_setting(self, key: str, value: str) -> None:
        self.row("Settings", key).locator("td").nth(1).click()
        field = self.widget("Settings").locator("input[type=number]")
        field.fill(value)
        field.press("Enter")
        expect(field).to_have_count(0)

    def call(self, path: str, **fields: object) -> Any:
        """Asks the server from the page's own origin, beside the client."""
        return self.page.evaluate(
            """([url, body]) => fetch(url, {
                method: "POST",
                headers: {"Content-Type": "application/json"},
                body: JSON.stringify(body),
            }).then(answer => answer.json())""",
            [f"http://localhost:{PORT}{path}", fields],
        )

    def series(self, act: Callable[[], object]) -> tuple[dict[str, Any], dict[str, Any]]:
        """The request and the answer of the chart's query that ``act`` brings about."""
        with self.page.expect_response(answer_to("/query-ts")) as caught:
            act()
        answer = caught.value
        return answer.request.post_data_json, answer.json()


def answer_to(path: str, **fields: object) -> Callable[[Any], bool]:
    """Whether a response is the answer to a POST to ``path`` with these fields."""

    def matches(response: Any) -> bool:
        request = response.request
        return (
            request.method == "POST"
            and response.url.endswith(path)
            and fields.items() <= request.post_data_json.items()
        )

    return matches


def eventually(look: Callable[[], Any], wanted: Any, timeout: float = 15.0) -> None:
    """Looks until it sees what is wanted; ``timeout`` is in seconds."""
    deadline = time.monotonic() + timeout
    while (seen := look()) != wanted:
        assert time.monotonic() < deadline, f"{seen!r} instead of {wanted!r} after {timeout} s"


@pytest.fixture(scope="module")
def client_folder() -> Path:
    folder = os.environ.get(FOLDER)
    if not folder:
        pytest.skip(f"{FOLDER} does not name the folder of a built shell-dashboard")
    if not (Path(folder) / "index.html").is_file():
        pytest.fail(f"{FOLDER}: no index.html in {folder}")
    return Path(folder)


@pytest.fixture(scope="module")
def site(client_folder: Path) -> Iterator[StaticSite]:
    with StaticSite(client_folder) as site:
        yield site


@pytest.fixture(scope="module")
def server(
    client_folder: Path,  # noqa: ARG001 (without a client there is nothing to start it for)
    tmp_path_factory: pytest.TempPathFactory,
) -> Iterator[Server]:
    if port_taken(PORT):
        pytest.skip(f"port {PORT}, which is fixed in the client, is taken")
    config = CONFIG.format(port=PORT, answer_delay=ANSWER_DELAY, command_time=COMMAND_TIME)
    with Server(tmp_path_factory.mktemp("toolpost"), config, listeners=2) as server:
        yield server
        assert server.stop() == 0
        assert "Traceback" not in server.log, server.log


@pytest.fixture(scope="module")
def session(browser: Browser, site: StaticSite, server: Server) -> Iterator[Dashboard]:  # noqa: ARG001
    """One page for all tests, as an operator leaves it open all day."""
    context = browser.new_context(viewport={"width": 1280, "height": 1600})
    context.grant_permissions(["clipboard-read", "clipboard-write"], origin=site.origin)
    page = context.new_page()
    dashboard = Dashboard(page, Watch(page))
    page.goto(site.origin)
    yield dashboard
    context.close()


@pytest.fixture(autouse=True)
def dashboard(session: Dashboard) -> Iterator[Dashboard]:
    """The page with an idle machine; after each test, nothing may have gone wrong in it."""
    try:
        session.expect_idle(timeout=5_000)
    except AssertionError:
        session.page.get_by_role("button", name="CANCEL ALL").click()
        try:
            session.expect_idle()
        except AssertionError as error:
            error.add_note("\n".join(session.watch.take_problems()))
            raise
    yield session
    assert session.watch.take_problems() == []


def test_status_shows_idle_and_busy(dashboard: Dashboard) -> None:
    jog = dashboard.button("Jog", "X+")
    expect(dashboard.status).to_have_text("🔵 idle")
    expect(jog).to_be_enabled()

    dashboard.execute("\n".join(f"G1 X{i}" for i in range(40)))

    dashboard.expect_busy()
    dashboard.expect_busy(re.compile(r"[1-9]\d* commands in queue"))
    expect(jog).to_be_disabled()
    expect(dashboard.button("Manual Command", "EXECUTE")).to_be_disabled()
    dashboard.expect_idle()
    expect(jog).to_be_enabled()


def test_pasted_job_runs_until_it_is_completed(dashboard: Dashboard, server: Server) -> None:
    steps = 60
    job = ["; made for a test", "G53", "", *(f"G1 X{i} Y{-i} ; step {i}" for i in range(steps))]
    job += ["  ", ";", "G1 X7 Y8 Z9"]
    seconds = steps * COMMAND_TIME
    before = len(dashboard.job_statuses())
    logged = len(sent_by(server))
    expect(dashboard.button("Add Job", "EXECUTE")).to_be_disabled()

    with dashboard.watch.answers("/add-job") as added:
        started = time.monotonic()
        dashboard.paste_job(job)
        dashboard.expect_busy(re.compile(r"Job \S+ running"))
        dashboard.expect_newest_job("RUNNING")
        dashboard.expect_newest_job("COMPLETED")
        took = time.monotonic() - started

    [(sent, answer)] = added
    assert answer["ok"] is True
    assert isinstance(answer["job_id"], str)
    assert sent["signals"] == {"?pos": 1, "?edm": 0.5}
    assert took >= seconds, "completed before its last command can have ended"
    dashboard.expect_idle()
    dashboard.expect_position("(machine) X7.000 Y8.000 Z9.000")
    assert len(dashboard.job_statuses()) == before + 1
    elapsed = dashboard.rows("Job List").first.locator("td").nth(2)
    assert int(elapsed.inner_text().removesuffix("s")) >= int(seconds)
    lines = sent_by(server)[logged:]
    moves = [f"G1 X{i} Y{-i}" for i in range(steps)]
    assert commands(lines) == ["G53", *moves, "G1 X7 Y8 Z9"]
    assert lines.count("?edm") >= seconds / 0.5 - 1


def test_job_list_has_the_newest_first_and_refreshes_itself(dashboard: Dashboard) -> None:
    before = len(dashboard.job_statuses())
    for _ in range(2):
        dashboard.paste_job(["G1 X1", "G1 X2"])
        dashboard.expect_newest_job("COMPLETED")
        dashboard.until_idle()
    heads = dashboard.widget("Job List").locator("th")
    expect(heads).to_have_text(["Status", "Started", "Elapsed"])
    with dashboard.page.expect_response(answer_to("/list-jobs"), timeout=8_000) as caught:
        pass
    jobs = caught.value.json()["jobs"]
    assert len(jobs) == before + 2
    assert len({job["job_id"] for job in jobs}) == len(jobs)
    for job in jobs[-2:]:
        assert job["status"] == "COMPLETED"
        assert job["time_added"] <= job["time_started"] <= job["time_ended"] <= time.time() + 0.1
    assert jobs[-2]["time_ended"] <= jobs[-1]["time_added"]
    expect(dashboard.rows("Job List")).to_have_count(before + 2)
    clock = "date => new Date(date * 1000).toLocaleString()"
    newest = dashboard.page.evaluate(clock, jobs[-1]["time_added"])
    expect(dashboard.rows("Job List").first.locator("td").nth(1)).to_have_text(newest)


def test_jog_moves_and_shows_the_position(dashboard: Dashboard) -> None:
    dashboard.run("G53\nG0 X10 Y10 Z10 C0")
    dashboard.expect_position("(machine) X10.000 Y10.000 Z10.000 C0.000")
    for step, button, shown in [
        ("1mm", "X+", "X11.000 Y10.000 Z10.000"),
        ("1mm", "Y-", "X11.000 Y9.000 Z10.000"),
        ("5mm", "Z+ (PULL)", "X11.000 Y9.000 Z15.000"),
        ("5mm", "Z- (PUSH)", "X11.000 Y9.000 Z10.000"),
        ("0.1mm", "X-", "X10.900 Y9.000 Z10.000"),
        ("0.1mm", "Y+", "X10.900 Y9.100 Z10.000"),
    ]:
        dashboard.widget("Jog").get_by_label(step, exact=True).check()
        dashboard.button("Jog", button).click(timeout=PATIENCE)
        dashboard.expect_position(f"(machine) {shown}")
    dashboard.widget("Jog").get_by_label("1mm", exact=True).check()
    dashboard.button("Jog", "REFRESH").click()
    errors = dashboard.errors()

    with dashboard.watch.answers("/write-line") as answers:
        dashboard.button("Jog", "HOME").click(timeout=PATIENCE)
        dashboard.until_idle()

    assert ({"line": "G28"}, True) in [(sent, answer["ok"]) for sent, answer in answers]
    assert dashboard.errors() == errors


def test_coordinate_systems_are_chosen_and_shown(dashboard: Dashboard) -> None:
    for button, shown in [
        ("WORK", "(work) X"),
        ("GRINDER", "(grinder) X"),
        ("TOOLSUPPLY", "(toolsupply) X"),
    ]:
        dashboard.button("Coordinate System", button).click(timeout=PATIENCE)
        dashboard.expect_position(shown)
    dashboard.button("Coordinate System", "MACHINE").click(timeout=PATIENCE)
    expect(dashboard.widget("Jog")).not_to_contain_text("(toolsupply)", timeout=PATIENCE)
    dashboard.position()


def test_settings_are_read_filtered_and_changed(dashboard: Dashboard) -> None:
    dashboard.refresh_settings()
    widget = dashboard.widget("Settings")
    rows = dashboard.rows("Settings")
    total = rows.count()
    assert total > 1
    expect(widget).to_contain_text(f"Showing {total}/{total} items")
    key, value = rows.first.inner_text().split("\t")
    value = value.strip()

    widget.get_by_placeholder("Enter filter...").fill(key.upper())
    assert 1 <= rows.count() < total
    expect(widget.locator(".highlight").first).to_have_text(key)
    widget.get_by_placeholder("Enter filter...").fill("")
    expect(rows).to_have_count(total)

    row = dashboard.row("Settings", key)
    dashboard.edit_setting(key, "37.5")
    expect(row).to_contain_text("(modified)")
    dashboard.button("Settings", "DISCARD EDITS").click()
    expect(row).not_to_contain_text("(modified)")
    expect(row).to_contain_text(value)

    dashboard.edit_setting(key, "42.5")
    with dashboard.watch.answers("/write-line") as answers:
        dashboard.button("Settings", "APPLY EDITS").click(timeout=PATIENCE)
        dashboard.until_idle()
    sent = [(request["line"], answer["ok"]) for request, answer in answers]
    assert (f"set {key} 42.5", True) in sent
    dashboard.refresh_settings()
    expect(row).to_contain_text("42.5")
    expect(row).not_to_contain_text("(modified)")  # so the machine says 42.5 too

    dashboard.edit_setting(key, value)
    dashboard.button("Settings", "APPLY EDITS").click(timeout=PATIENCE)
    dashboard.until_idle()
    dashboard.refresh_settings()
    expect(row).not_to_contain_text("(modified)")


def test_init_lines_are_saved_and_sent_by_the_init_button(dashboard: Dashboard) -> None:
    dashboard.refresh_settings()
    rows = dashboard.rows("Settings")
    key, value = (text.strip() for text in rows.first.inner_text().split("\t"))
    row = dashboard.row("Settings", key)

    with dashboard.page.expect_response(answer_to("/set-init")) as caught:
        dashboard.button("Settings", "SAVE AS INIT").click()
    lines = caught.value.request.post_data_json["lines"]
    assert len(lines) == rows.count()
    assert f"set {key} {value}" in lines
    assert caught.value.json() == {}

    dashboard.run(f"set {key} 12.5")
    dashboard.refresh_settings()
    expect(row).to_contain_text("(modified)")  # the page keeps its own value, the machine differs

    with (
        dashboard.watch.answers("/write-line") as answers,
        dashboard.page.expect_response(answer_to("/get-init")) as caught,
    ):
        dashboard.button("Manual Command", "INIT").click(timeout=PATIENCE)
        dashboard.until_idle()
    assert caught.value.json()["lines"] == lines
    sent = [request["line"] for request, answer in answers if answer["ok"]]
    # The page sends them all at once, over several connections: their order is not defined.
    assert sorted(line for line in sent if not line.startswith("?")) == sorted(lines)

    dashboard.refresh_settings()
    expect(row).not_to_contain_text("(modified)")
    expect(row).to_contain_text(value)


def test_stats_are_dumped_and_filtered(dashboard: Dashboard) -> None:
    widget = dashboard.widget("Stats")
    dashboard.button("Stats", "DUMP STATS").click(timeout=PATIENCE)
    expect(widget).to_contain_text("Last fetch: ", timeout=PATIENCE)
    rows = dashboard.rows("Stats")
    total = rows.count()
    assert total > 0
    expect(widget).to_contain_text(f"Showing {total}/{total} items")
    key = rows.first.inner_text().split("\t")[0].strip()
    widget.get_by_placeholder("Enter filter...").fill(key)
    expect(dashboard.row("Stats", key)).to_have_count(1)
    expect(widget.locator(".highlight").first).to_have_text(key)
    widget.get_by_placeholder("Enter filter...").fill("no such statistic")
    expect(widget).to_contain_text(f"Showing 0/{total} items")
    widget.get_by_placeholder("Enter filter...").fill("")
    expect(rows).to_have_count(total)


def test_chart_shows_what_a_job_reported(dashboard: Dashboard) -> None:
    widget = dashboard.widget("Timeseries")
    dashboard.paste_job([f"G1 X{i}" for i in range(60)])
    dashboard.expect_newest_job("COMPLETED")
    dashboard.page.wait_for_timeout(1_200)  # the chart ends at the last full second

    for span, step, act in [
        (60, 1, lambda: dashboard.button("Timeseries", "REFRESH").click()),
        (600, 10, lambda: widget.get_by_label("10m", exact=True).check()),
        (3600, 60, lambda: widget.get_by_label("60m", exact=True).check()),
        (60, 1, lambda: widget.locator("input[name=span][value='60']").check()),
    ]:
        asked, got = dashboard.series(act)
        assert (asked["end"] - asked["start"], asked["step"]) == (span, step)
        times = [asked["start"] + i * step for i in range(span // step + 1)]
        assert got["times"] == pytest.approx(times, abs=1e-6)
        assert got["values"].keys() == set(asked["query"])
        for key, values in got["values"].items():
            assert len(values) == len(times), key
            assert all(value is None or isinstance(value, int | float) for value in values), key
        seen = {key: [v for v in got["values"][key] if v is not None] for key in asked["query"]}
        assert seen["edm.open"], f"no ?edm of the job in {span} s"
        assert seen["edm.short"]
        assert seen["queue.num"]
        if step == 1:
            assert len(seen["edm.open"]) >= 3

    dashboard.watch.settle()
    # Chart.js gives its second line, edm.open, this red; the legend is above the plot.
    drawn = widget.locator("canvas").evaluate(
        """canvas => {
            const top = Math.floor(canvas.height / 4);
            const height = canvas.height - top;
            const image = canvas.getContext("2d").getImageData(0, top, canvas.width, height).data;
            let red = 0;
            for (let i = 0; i < image.length; i += 4)
                if (image[i] > 240 && Math.abs(image[i + 1] - 99) < 20
                    && Math.abs(image[i + 2] - 132) < 20 && image[i + 3] > 200) red++;
            return red;
        }"""
    )
    assert drawn > 0


def test_errors_of_the_machine_are_shown(dashboard: Dashboard) -> None:
    before = dashboard.errors()
    dashboard.run("BOGUS 1")
    eventually(lambda: len(dashboard.errors()), len(before) + 1)
    stamp, message, *_ = dashboard.errors()[0].split("\t")
    assert message.strip()
    assert dashboard.page.evaluate("stamp => !isNaN(Date.parse(stamp))", stamp)
    expect(dashboard.widget("Errors").locator("th")).to_have_text(["Timestamp", "Error", "Source"])


def test_manual_command_moves_the_machine(dashboard: Dashboard) -> None:
    widget = dashboard.widget("Manual Command")
    text = widget.locator("textarea")
    errors = dashboard.errors()
    dashboard.run("G53\nG0 X3.25 Y4 Z-5")
    dashboard.expect_position("(machine) X3.250 Y4.000 Z-5.000")
    expect(text).to_have_value("")

    widget.get_by_label("Clear on exec").uncheck()
    dashboard.run("G0 X6")
    dashboard.expect_position("(machine) X6.000 Y4.000 Z-5.000")
    expect(text).to_have_value("G0 X6")
    widget.get_by_label("Clear on exec").check()
    text.fill("")
    expect(dashboard.button("Manual Command", "EXECUTE")).to_be_disabled()
    assert dashboard.errors() == errors


def test_empty_lines_and_comments_in_a_manual_batch(dashboard: Dashboard) -> None:
    with dashboard.watch.answers("/write-line") as answers:
        dashboard.execute("\n\nG53\nG0 X11 ; to the right\n   \nG0 Y12;up\n\n")
        dashboard.expect_position("(machine) X11.000 Y12.000")
    lines = [request["line"] for request, answer in answers if answer["ok"]]
    assert [line for line in lines if line != "?pos"] == ["G53", "G0 X11", "G0 Y12"]

    # The page sends an empty line for a line that is only a comment, and would drop the rest of the
    # batch if that were refused: half of it would have been executed.
    dashboard.expect_idle()
    with dashboard.watch.answers("/write-line") as answers:
        dashboard.execute("G0 X13\n; only a comment\nG0 X14")
        dashboard.expect_position("(machine) X14.000 Y12.000")
    sent = [(request["line"], answer["ok"]) for request, answer in answers if request["line"] != "?pos"]
    assert sent == [("G0 X13", True), ("", True), ("G0 X14", True)]


def test_cancel_ends_a_running_job(dashboard: Dashboard, server: Server) -> None:
    dashboard.run("G53\nG0 X0 Y0 Z0")
    before = len(dashboard.job_statuses())
    logged = len(sent_by(server))
    dashboard.paste_job([f"G1 X{i}" for i in range(1, 401)])
    dashboard.expect_busy(re.compile(r"Job \S+ running"))
    dashboard.page.wait_for_timeout(1_000)
    with dashboard.page.expect_response(answer_to("/cancel")):
        dashboard.page.get_by_role("button", name="CANCEL ALL").click()

    dashboard.page.wait_for_timeout(300)  # the `!` is on its way
    dashboard.call("/write-line", line="?pos")
    dashboard.page.wait_for_timeout(300)
    [stopped] = dashboard.call("/get-ps", tag="pos")["pstates"]
    dashboard.expect_idle(timeout=5_000)
    dashboard.expect_newest_job("CANCELED")
    assert len(dashboard.job_statuses()) == before + 1
    assert 0 < stopped["kv"]["m.x"] < 200
    dashboard.page.wait_for_timeout(2_500)  # two rounds of the page's polling
    now = dashboard.position()["X"]
    assert now == pytest.approx(stopped["kv"]["m.x"], abs=0.0011), "it moved after a cancel"
    lines = sent_by(server)[logged:]
    assert lines.count("!") == 1
    assert commands(lines[lines.index("!") :]) == []

    dashboard.run("G0 X1 Y2")  # and it can be used again
    dashboard.expect_position("(machine) X1.000 Y2.000")
    assert dashboard.job_statuses()[0] == "CANCELED"


def test_cancel_of_nothing_changes_nothing(dashboard: Dashboard) -> None:
    jobs = dashboard.job_statuses()
    position = dashboard.position()
    with dashboard.page.expect_response(answer_to("/cancel")) as caught:
        dashboard.page.get_by_role("button", name="CANCEL ALL").click()
    assert caught.value.json() == {}
    dashboard.until_idle()
    assert dashboard.job_statuses() == jobs
    assert dashboard.position() == position


def test_tool_supply_attaches_in_one_burst(dashboard: Dashboard, server: Server) -> None:
    errors = dashboard.errors()
    logged = len(sent_by(server))
    with dashboard.watch.answers("/write-line") as answers:
        dashboard.button("Tool Supply", "ATTACH").click(timeout=PATIENCE)
        dashboard.expect_busy(re.compile(r"\d+ commands in queue"))
        dashboard.page.wait_for_timeout(1_000)
        dashboard.expect_idle(timeout=60_000)
        # The last line of the longest chain: the page sends each after the answer to the one
        # before, beside four other chains and seven single lines.
        dashboard.expect_position("X0.000 Y0.000 Z-12.000")
    sent = [request["line"] for request, _ in answers if request["line"] != "?pos"]
    assert len(sent) >= 130
    assert all(answer["ok"] for _, answer in answers)
    done = commands(sent_by(server)[logged:])
    assert Counter(done) == Counter(sent)
    insert = [line for line in sent if re.fullmatch(r"G0 X\S+ Y\S+ Z\S+", line)]
    assert [line for line in done if line in insert] == insert, "not in the order of arrival"
    clamp = ["G0 C0", "G0 C240", "G0 C120", "G0 C0", "G0 C240", "G0 C120", "G0 C0"]
    assert sorted(line for line in sent if " C" in line) == sorted(clamp)
    assert {"M60", "M61", "G53", "G56"} <= set(sent)
    assert dashboard.errors() == errors


def test_tool_supply_by_single_actions(dashboard: Dashboard) -> None:
    errors = dashboard.errors()
    dashboard.widget("Tool Supply").get_by_label("Individual actions").check()
    with dashboard.watch.answers("/write-line") as answers:
        for name in ["MOVE", "OPEN", "UNCLAMP", "PULL", "CLOSE"]:
            dashboard.button("Tool Supply", name).first.click(timeout=PATIENCE)
            dashboard.until_idle()
    dashboard.widget("Tool Supply").get_by_label("Individual actions").uncheck()
    expect(dashboard.button("Tool Supply", "ATTACH")).to_be_visible()
    sent = [request["line"] for request, answer in answers if answer["ok"]]
    assert [line for line in sent if line != "?pos"] == [
        *["G56", "G0 X0 Y0 Z47.000", "M60"],
        *["G0 C0", "G0 C120", "G0 C240", "G0 C0"],
        *["G0 Z47.000", "G53", "M61"],
    ]
    assert dashboard.errors() == errors


def test_scan_measures_a_surface(dashboard: Dashboard) -> None:
    errors = dashboard.errors()
    widget = dashboard.widget("Scan")
    dashboard.button("Scan", "PREPARE").click(timeout=PATIENCE)
    dashboard.until_idle()
    dashboard.button("Scan", "SCAN").click(timeout=PATIENCE)
    expect(widget).to_contain_text(re.compile(r"N=1 \(avg=-?\d+\.\d{3}, min=-?\d+"), timeout=60_000)
    dashboard.until_idle()
    dashboard.button("Scan", "RESET").click()
    expect(widget).to_contain_text("N=0 (avg=N/A, min=N/A, max=N/A)")
    dashboard.run("G53")
    assert dashboard.errors() == errors


def test_page_sees_the_server_go_and_come_back(dashboard: Dashboard, server: Server) -> None:
    dashboard.paste_job(["G1 X1"])
    dashboard.expect_newest_job("COMPLETED")
    jobs = dashboard.job_statuses()
    init = dashboard.call("/get-init")
    with dashboard.watch.provoked() as provoked:
        assert server.stop() == 0
        expect(dashboard.status).to_have_text("⚫ offline", timeout=PATIENCE)
        expect(dashboard.button("Jog", "X+")).to_be_disabled()
        server.start()
        dashboard.expect_idle()
        # A failed request ends the page's own polling of the position until it is loaded again.
        dashboard.page.reload()
        dashboard.expect_idle()
    assert any("ERR_CONNECTION_REFUSED" in text for text in provoked)
    assert not any(text.startswith("status") for text in provoked), provoked

    assert dashboard.job_statuses() == jobs
    dashboard.position()
    assert dashboard.call("/get-init") == init


def test_screenshots(dashboard: Dashboard) -> None:
    folder = os.environ.get(SCREENSHOTS)
    if not folder:
        pytest.skip(f"{SCREENSHOTS} is not set")
    target = Path(folder)
    target.mkdir(parents=True, exist_ok=True)
    page = dashboard.page
    dashboard.refresh_settings()
    dashboard.button("Stats", "DUMP STATS").click(timeout=PATIENCE)
    expect(dashboard.widget("Stats")).to_contain_text("Last fetch: ", timeout=PATIENCE)
    dashboard.paste_job([f"G1 X{i % 7} Y{i}" for i in range(100)])
    dashboard.expect_busy(re.compile(r"Job \S+ running"))
    dashboard.expect_newest_job("RUNNING")
    page.evaluate("scrollTo(0, 0)")
    page.screenshot(path=target / "shell-dashboard-busy.png", full_page=True)
    dashboard.expect_newest_job("COMPLETED")
    page.wait_for_timeout(1_500)
    dashboard.series(lambda: dashboard.button("Timeseries", "REFRESH").click())
    dashboard.errors()
    dashboard.expect_idle()
    page.wait_for_timeout(1_500)
    page.evaluate("scrollTo(0, 0)")
    page.screenshot(path=target / "shell-dashboard-idle.png", full_page=True)
    for heading in page.locator(".widget h1").all_inner_texts():
        name = heading.lower().replace(" ", "-")
        try:
            dashboard.widget(heading).screenshot(path=target / f"shell-dashboard-{name}.png")
        except Error as error:
            pytest.fail(f"{heading}: {error}")
