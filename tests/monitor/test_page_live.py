"""The page of one live run in a real browser: it grows, warns, commands, and outlives a gateway."""

import re
from contextlib import ExitStack
from pathlib import Path

import pytest

from tests.builders.ports import free_port
from tests.live.test_live import QUICK, finish, kill, read_until, start
from tests.monitor.browser import Browser, open_browser
from tests.security.laboratory import laboratory
from twin.rig.keys import issue_code

pytestmark = pytest.mark.slow
TEST = QUICK.replace("cycles = 5", "cycles = 8", 1)
SEND_STOP = """fetch("command", {
  method: "POST", headers: { ...headers(), "Content-Type": "application/json" },
  body: JSON.stringify({ command: "stop", run: state.run.run }),
}).then((answer) => answer.status)"""
COUNT = "parseInt(document.getElementById('points').textContent)"


def press(browser: Browser, command: str, state: str) -> None:
    """Give a command and confirm it, again where a gateway has just been replaced."""
    for _ in range(5):
        browser.wait_for("!$('commands').hidden")
        browser.evaluate(f"document.querySelector('[data-command={command}]').click()")
        assert browser.text("question") == f"{command} the test?"
        browser.evaluate("$('yes').click()")
        browser.wait_for("$('answer').className")
        if browser.evaluate("$('answer').className") == "good":
            break
    browser.wait_for(f"state.state.state === {state!r}")


def test_the_page_of_a_live_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    lab, port, place = laboratory(tmp_path / "lab"), free_port(), f"tls/127.0.0.1:{free_port()}"
    capsys.readouterr()
    for name in ("anna", "bob"):
        issue_code(lab, name, "")
    anna, bob = re.findall(r"[a-z2-7]{4}(?:-[a-z2-7]{4}){5}", capsys.readouterr().out)
    page = f"https://127.0.0.1:{port}/"
    options = ("--listen", place, "--keys", str(lab), "--web-listen", f"127.0.0.1:{port}")
    with (
        ExitStack() as after,
        open_browser(tmp_path / "profile", "--ignore-certificate-errors") as browser,
    ):
        process = start(tmp_path, *options, profile=TEST)
        after.callback(process.terminate)  # no table goes on where the test fails
        assert page in read_until(process, "page:")

        browser.open(page)
        browser.wait_for("!document.getElementById('login').hidden")
        browser.open("about:blank")
        browser.open(f"{page}#{bob}", width=420, dark=True)
        browser.wait_for("state.state?.state === 'running'")
        assert browser.evaluate("location.hash + document.cookie") == ""
        assert browser.text("user") == "bob, role observe"
        assert browser.evaluate("$('commands').hidden")
        assert browser.evaluate(SEND_STOP) == 403
        browser.wait_for(
            "[...$('events').children].some((line) => line.textContent.includes('stop by bob'))"
        )
        assert browser.evaluate("document.documentElement.scrollWidth") == 420

        browser.open("about:blank")
        browser.open(f"{page}#{anna}")
        press(browser, "hold", "holding")
        kill(process, "gate")
        browser.wait_for("state.events.rows.some((event) => event.text.includes('gate died'))")
        press(browser, "resume", "running")
        first = browser.wait_for(COUNT)
        browser.wait_for(f"{COUNT} > {first}")
        browser.wait_for("state.state.ended")
        assert browser.evaluate("state.trace.tracks.measured.u.length > 50")
        assert browser.text("state") == "ended: complete"
        assert browser.evaluate("$('commands').hidden")
        assert [text for text in browser.console if "401" not in text and "403" not in text] == []
        after.pop_all()
    code, output, recording, summary = finish(process, tmp_path)
    assert code == 0, output
    assert "hold: requested from the page by anna" in output
    assert "stop by bob: bob has the role observe" in output
    assert summary["gaps"] == 0
    assert recording.is_intact
