"""The page in a real browser, fed with a test as it goes on; a live run is in `test_page_live`."""

import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from table_io.records import Event, RunStop
from tests.monitor.browser import PATIENCE_S, Browser, open_browser
from tests.monitor.monitored import RUN, point, receive, records, stream
from tests.monitor.test_page_server import Served, serving
from tests.security.laboratory import laboratory, own
from twin.monitor.page_data import build_sections
from twin.monitor.page_server import CommandAnswer, PageCommand, PageServer, open_page_server
from twin.monitor.run_state import LiveRunState, update_run_state
from twin.monitor.run_view import RunView, SessionStatus
from twin.security.access_control import user_name

HAS_INK = """((canvas) => canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height)
  .data.some((value) => value > 0))(document.getElementById(ID))"""


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    with open_browser(tmp_path_factory.mktemp("chromium") / "profile") as browser:
        yield browser


def show(page: Served, state: LiveRunState) -> None:
    page.feed.publish(build_sections(RunView(state, SessionStatus())))


def test_the_page_shows_a_test_as_it_goes_on(browser: Browser) -> None:
    state = receive(*records(), *stream())
    with serving(answer=403) as page:
        show(page, state)
        browser.open(f"http://127.0.0.1:{page.port}/", width=420, dark=True)
        browser.wait_for("$('state').textContent === 'running'")
        assert browser.evaluate("document.documentElement.scrollWidth") == 420
        assert browser.text("points").startswith("3 ")
        assert "3.98" in browser.text("forecast")
        for plot in ("level-scale", "u", "force", "prc"):
            assert browser.evaluate(HAS_INK.replace("ID", repr(plot))), plot
        assert browser.evaluate("[...document.querySelectorAll('#twin .bad')].length") == 1

        update_run_state(state, RUN, point(3))
        update_run_state(state, RUN, Event(8000, "divergence", "<img src=x onerror=alert(1)>"))
        show(page, state)
        browser.wait_for("$('points').textContent.startsWith('4 ')")
        first = "document.querySelector('#events li')"
        assert "<img src=x" in browser.evaluate(f"{first}.textContent")
        assert (
            browser.evaluate(f"{first}.className + {first}.querySelectorAll('img').length")
            == "warn0"
        )

        assert browser.evaluate("$('commands').hidden")  # without the role
        page.feed.role = "command"
        show(page, state)
        browser.wait_for("!$('commands').hidden")
        browser.evaluate("document.querySelector('[data-command=stop]').click()")
        assert page.commands == []
        browser.evaluate("$('yes').click()")
        browser.wait_for("$('answer').className === 'bad'")
        assert page.commands == [PageCommand("stop", RUN, user_name(None))]

        update_run_state(state, RUN, RunStop(9000, "stopped", "asked to stop"))
        show(page, state)
        browser.wait_for("$('state').textContent === 'ended: stopped' && $('commands').hidden")
    assert [text for text in browser.console if "403" not in text] == []


def test_the_page_draws_sections_as_they_arrive(browser: Browser) -> None:
    """A slow network delivers the first message in pieces; drawing survives a damaged one."""
    state = receive(*records(), *stream())
    sections = build_sections(RunView(state, SessionStatus()))
    with serving() as page:
        page.feed.publish({name: sections[name] for name in ("run", "state")})
        browser.open(f"http://127.0.0.1:{page.port}/")
        browser.wait_for("$('state').textContent === 'running'")
        page.feed.publish(sections)
        browser.wait_for("$('points').textContent.startsWith('3 ')")
        page.feed.publish(sections | {"trace": "{}"})
        browser.wait_for("!state.trace.tracks && !dirty")
        update_run_state(state, RUN, RunStop(9000, "stopped", "asked to stop"))
        show(page, state)
        browser.wait_for("$('state').textContent === 'ended: stopped'")


def test_a_command_without_an_answer_points_to_the_emergency_stop(browser: Browser) -> None:
    over = threading.Event()

    def never_answer(_: PageCommand) -> CommandAnswer:
        over.wait(2 * PATIENCE_S)
        return CommandAnswer(200, "")

    with serving() as page:
        page.server.handle_command = never_answer
        page.feed.role = "command"
        show(page, receive(*records()))
        browser.open(f"http://127.0.0.1:{page.port}/")
        browser.evaluate("answerMs = 500")
        browser.wait_for("!$('commands').hidden")
        browser.evaluate("document.querySelector('[data-command=stop]').click()")
        browser.evaluate("$('yes').click()")
        try:
            browser.wait_for("$('answer').textContent.includes('use the machine\\'s own stop')")
        finally:
            over.set()


def test_a_code_is_taken_as_keyboards_write_it(browser: Browser, tmp_path: Path) -> None:
    """A dash for a hyphen, as phones write it; a wrong code asks again."""
    with serving(own(laboratory(tmp_path / "lab"), "anna")) as page:
        show(page, receive(*records()))
        browser.open("about:blank")
        browser.open(f"http://127.0.0.1:{page.port}/")
        dashed = page.server.access.code.upper().replace("-", "–")
        for code in ("–", "wrong", dashed):
            browser.wait_for("!$('login').hidden")
            browser.evaluate(f"$('code').value = {code!r}; $('login').requestSubmit()")
        browser.wait_for("$('user').textContent === 'anna'")
        assert browser.evaluate("$('login').hidden")


def test_the_page_finds_its_server_again(browser: Browser) -> None:
    state = receive(*records())
    with serving() as page:
        show(page, state)
        browser.open(f"http://127.0.0.1:{page.port}/")
        browser.evaluate("silenceMs = 500")
        browser.wait_for("$('state').textContent === 'running'")
        server: PageServer = page.server
        page.feed.close()
        server.shutdown()
        server.server_close()
        browser.wait_for("$('state').textContent === 'page disconnected'")
        page.feed = type(page.feed)()
        update_run_state(state, RUN, point(3))
        show(page, state)
        page.server = open_page_server(
            "127.0.0.1", page.port, server.access, page.feed, server.handle_command
        )
        browser.wait_for("$('points').textContent.startsWith('4 ')")
        browser.wait_for("$('state').textContent === 'running'")
        page.feed.close()
        page.server.shutdown()
        page.server.server_close()
