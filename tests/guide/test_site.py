"""The guide as its reader gets it: pages, links and anchors, pictures, no network."""

import json
import re
import subprocess
import sys
from collections import Counter
from html.parser import HTMLParser
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

import pytest
from typer.main import get_command

from tests.command_line import call_main
from tests.input_errors import raises_input_error
from twin.cli.table import app
from twin.guide.markdown import render_markdown
from twin.guide.reference import PACKAGES_DIR
from twin.guide.site import CHAPTERS, Chapter, GuidePage, build_guide

ROOT = Path(__file__).resolve().parents[2]
PROGRAM: Any = get_command(app)
FILE_NAME = re.compile(r"^(?:\.github|profiles|table_io|tests|twin)/[\w./-]+\.\w+$")


class PageParser(HTMLParser):
    """Targets, anchors, code texts and formulas of a page."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.targets: list[str] = []
        self.resources: list[str] = []
        self.anchors: list[str] = []
        self.codes: list[str] = []
        self.tags: Counter[str] = Counter()
        self._in_code = False
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags[tag] += 1
        values = {name: value or "" for name, value in attrs}
        self.targets += [values["href"]] if tag == "a" and "href" in values else []
        self.resources += [values[key] for key in ("src",) if key in values]
        self.resources += [values["href"]] if tag == "link" else []
        self.anchors += [values["id"]] if "id" in values else []
        self._in_code = tag == "code"
        if self._in_code:
            self.codes.append("")

    def handle_endtag(self, tag: str) -> None:
        self._in_code = self._in_code and tag != "code"

    def handle_data(self, data: str) -> None:
        if self._in_code:
            self.codes[-1] += data


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build_guide(tmp_path_factory.mktemp("guide"), PROGRAM).parent


@pytest.fixture(scope="module")
def pages(site: Path) -> dict[str, PageParser]:
    return {path.name: PageParser(path.read_text()) for path in site.glob("*.html")}


def list_broken(site: Path, pages: dict[str, PageParser]) -> list[str]:
    """List the links and pictures of a site that lead nowhere inside it."""
    broken = []
    for name, page in pages.items():
        for target in [*page.targets, *page.resources]:
            parts = urlsplit(target)
            if parts.scheme:
                is_foreign = target in page.resources and parts.scheme != "data"
                broken += [f"{name}: {target}"] * is_foreign
                continue
            file = unquote(parts.path) or name
            linked = pages.get(file)
            is_broken = not (site / file).is_file()
            if parts.fragment and not is_broken:
                is_broken = linked is None or unquote(parts.fragment) not in linked.anchors
            broken += [f"{name}: {target}"] * is_broken
    return broken


def test_every_page_is_there_and_no_link_is_broken(
    site: Path, pages: dict[str, PageParser]
) -> None:
    assert {page.file_name for chapter in CHAPTERS for page in chapter.pages} == set(pages)
    assert sum(len(page.targets) for page in pages.values()) > 100
    assert list_broken(site, pages) == []
    for name, page in pages.items():
        assert [anchor for anchor, count in Counter(page.anchors).items() if count > 1] == [], name
        assert page.tags["h1"] >= 1, name


def test_a_broken_link_of_a_built_page_is_noticed(tmp_path: Path) -> None:
    (tmp_path / "a.html").write_text('<h1 id="here">A</h1><a href="#there"></a><img src="b.png">')
    pages = {"a.html": PageParser((tmp_path / "a.html").read_text())}
    assert list_broken(tmp_path, pages) == ["a.html: #there", "a.html: b.png"]


def test_every_file_that_the_guide_names_exists(pages: dict[str, PageParser]) -> None:
    names = {code for page in pages.values() for code in page.codes if FILE_NAME.match(code)}
    assert names
    assert sorted(name for name in names if not (ROOT / name).exists()) == []


def test_every_command_that_the_guide_names_exists(pages: dict[str, PageParser]) -> None:
    lines = [line for page in pages.values() for code in page.codes for line in code.splitlines()]
    names = {match[1] for line in lines if (match := re.match(r"shaketwin ([a-z]+)\b", line))}
    assert len(names) > 20
    assert names - PROGRAM.commands.keys() == set()


def test_no_text_is_taken_for_a_tag(pages: dict[str, PageParser]) -> None:
    """Such as <date> outside of code, which a browser would swallow."""
    placeholders = {"date", "time", "name", "folder", "file", "who", "log", "profile", "topic"}
    assert [name for name, page in pages.items() if placeholders & page.tags.keys()] == []


def test_the_build_refuses_links_that_lead_nowhere(tmp_path: Path) -> None:
    (tmp_path / "a.md").write_text("# A\n[x](b.md) [y](#nowhere) [z](#a)")
    chapters = (Chapter("Start", (GuidePage("a", "A", tmp_path / "a.md"),)),)
    with raises_input_error(where="guide") as caught:
        build_guide(tmp_path / "site", PROGRAM, chapters)
    assert [fault.value for fault in caught.value.faults] == ["b.md", "a.html#nowhere"]


def test_only_a_guide_is_replaced(tmp_path: Path) -> None:
    text = tmp_path / "a.md"
    text.write_text("# A")
    chapters = (Chapter("Start", (GuidePage("index", "A", text),)),)
    folder = tmp_path / "site"
    first = build_guide(folder, PROGRAM, chapters)
    text.write_text("# B")
    assert "B</h1>" in build_guide(folder, PROGRAM, chapters).read_text()
    first.write_text("mine")
    with raises_input_error(key="--out", value=str(folder)):
        build_guide(folder, PROGRAM, chapters)
    assert first.read_text() == "mine"


def test_formulas_are_mathml_and_names_of_pages_are_links() -> None:
    page = render_markdown(
        "# A\n\n$$\\frac{u}{2}$$\n\n## B `c`\n\n`KEYS.md` costs 3$ or 4$",
        lambda target: target,
        lambda name: "keys.html" if name.endswith(".md") else "",
    )
    assert "<mfrac>" in page.html
    assert page.html.count("<math") == 1
    assert '<a href="keys.html"><code>KEYS.md</code></a>' in page.html
    assert [(heading.level, heading.text, heading.anchor) for heading in page.headings] == [
        (1, "A", "a"),
        (2, "B c", "b-c"),
    ]


def test_the_command_writes_the_site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    opened: list[str] = []

    def open_browser(address: str) -> bool:
        opened.append(address)
        return True

    monkeypatch.setattr("webbrowser.open", open_browser)
    monkeypatch.setenv("DISPLAY", ":0")
    assert call_main("guide", "--out", tmp_path / "site").returncode == 0
    assert (tmp_path / "site" / "index.html").is_file()
    assert opened == []
    result = call_main("guide")
    assert result.returncode == 0
    index = Path(unquote(urlsplit(opened[0]).path))
    assert index.is_file()
    assert str(index) in result.stdout
    (tmp_path / "file").touch()
    assert call_main("guide", "--out", tmp_path / "file").returncode == 2


def test_the_guide_imports_no_kernels() -> None:
    """They would be compiled first, for a minute."""
    program = (
        "import sys, twin.guide.site, twin.guide.command;"
        "print([name for name in sys.modules if name.startswith('twin') and 'kernel' in name])"
    )
    result = subprocess.run(
        [sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=True
    )
    assert result.stdout.strip() == "[]"


def test_all_pages_of_the_packages_are_in_the_guide() -> None:
    listed = {page.markdown_path for chapter in CHAPTERS for page in chapter.pages}
    written = {
        path
        for package in ("table_io", "twin")
        for path in (PACKAGES_DIR / package).rglob("*.md")
        if path.name != "README.md"
    }
    assert written - listed == set()


def test_search_leads_to_every_section_by_its_text(site: Path) -> None:
    script = (site / "search.js").read_text(encoding="utf-8")
    sections = json.loads(script.partition("const sections = ")[2].partition(";\n")[0])
    assert {link.partition("#")[0] for link, *_ in sections} == {
        p.name for p in site.glob("*.html")
    }
    for link, _, heading, _ in sections:
        name, _, anchor = link.partition("#")
        assert not anchor or f'id="{anchor}"' in (site / name).read_text(encoding="utf-8")
        assert "<" not in heading
    assert any("gain_residual_percent" in text for *_, text in sections)
