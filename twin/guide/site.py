"""The guide as a folder of HTML pages that need no network, and the table of its pages."""

import json
import os
import re
import shutil
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import urlsplit

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup
from typer.core import TyperGroup

from table_io.errors import InputError
from twin.guide.gallery import write_gallery
from twin.guide.markdown import RenderedMarkdown, convert_notebook, render_markdown
from twin.guide.paper_gap import write_paper_gap
from twin.guide.reference import (
    PACKAGES_DIR,
    write_api_reference,
    write_channel_reference,
    write_command_reference,
    write_key_reference,
)

PAGES_DIR = Path(__file__).parent / "pages"
TUTORIALS_DIR = Path(__file__).parent / "tutorials"
FILES_FOLDER = "files"  # pictures and notebooks
SEARCH_FILE = "search.js"
GUIDE_MARK = '<meta name="generator" content="shaketwin guide">'


@dataclass(frozen=True, slots=True)
class GuidePage:
    """Page of the guide: file name without suffix, title, and its Markdown.

    `source` is the file of the text. A generated page has a function of the command line in its
    place, and links name it by `slug` + ".md".
    """

    slug: str
    title: str
    source: "Path | Callable[[TyperGroup], str]"

    @property
    def file_name(self) -> str:
        return f"{self.slug}.html"

    @property
    def markdown_path(self) -> Path:
        return self.source if isinstance(self.source, Path) else PAGES_DIR / f"{self.slug}.md"

    def read(self, program: TyperGroup) -> str:
        """Return the Markdown."""
        if not isinstance(self.source, Path):
            return self.source(program)
        text = self.source.read_text(encoding="utf-8")
        return convert_notebook(text, self.source.name) if self.source.suffix == ".ipynb" else text


@dataclass(frozen=True, slots=True)
class Chapter:
    """Group of pages in the navigation."""

    title: str
    pages: tuple[GuidePage, ...]


def _tutorial(slug: str, title: str) -> GuidePage:
    return GuidePage(slug, title, TUTORIALS_DIR / f"{slug}.ipynb")


def _page(slug: str, title: str, source: str = "") -> GuidePage:
    return GuidePage(slug, title, PACKAGES_DIR / source if source else PAGES_DIR / f"{slug}.md")


CHAPTERS = (
    Chapter(
        "Start",
        (
            _page("index", "Overview"),
            _page("install", "Install"),
            _page("first-hour", "First hour"),
            _page("laboratory-day", "A laboratory day"),
            _page("archive", "An archive of runs"),
            _page("while-it-runs", "While a test runs"),
            _page("earthquakes", "Earthquakes"),
            _page("qualification", "A qualification test"),
            _page("studies", "Studies over parameters"),
        ),
    ),
    Chapter(
        "Your table and your data",
        (
            _page("connect", "Connect your table", "table_io/CONNECT.md"),
            _page("ni", "NI-DAQmx", "table_io/backends/ni/NI.md"),
            _page("udp", "UDP target", "table_io/backends/udp/PACKETS.md"),
            _page("follow", "External controller", "table_io/acquisition/FOLLOW.md"),
            _page("imperfections", "Imperfect laboratory", "table_io/sim/IMPERFECTIONS.md"),
            _page("foreign-data", "Data of others", "twin/exchange/FOREIGN_DATA.md"),
            _page("security", "Security", "twin/security/KEYS.md"),
        ),
    ),
    Chapter(
        "Tutorials in Python",
        (
            _tutorial("look-at-a-log", "Look at a log"),
            _tutorial("fit-a-specimen", "Fit a specimen"),
            _tutorial("find-a-hidden-effect", "Find a hidden effect"),
            _tutorial("import-your-csv", "Import your CSV"),
            _tutorial("write-an-effect", "Write an effect"),
            _tutorial("write-a-backend", "Write a backend"),
        ),
    ),
    Chapter(
        "Understand",
        (
            _page("theory", "Theory"),
            _page("conventions", "Conventions"),
            _page("controller", "The controller"),
            _page("discovery", "Identification and discovery"),
            GuidePage("effects", "Effects", write_gallery),
            GuidePage("paper-gap", "The paper's own gap", write_paper_gap),
            _page("recording", "What a recording holds"),
            _page("inside", "How it is built"),
            _page("how-good", "How good discovery is"),
            _page("glossary", "Glossary"),
        ),
    ),
    Chapter(
        "Reference",
        (
            GuidePage("api", "Python API", write_api_reference),
            GuidePage("commands", "Commands", write_command_reference),
            GuidePage("keys", "Configuration keys", write_key_reference),
            GuidePage("channels", "Channels", write_channel_reference),
            _page("messages", "Messages and exit codes"),
            _page("troubleshooting", "Troubleshooting"),
            _page("log", "Format of the log", "twin/recording/LOG.md"),
            _page("exchange", "Import and export", "twin/exchange/EXCHANGE.md"),
            _page("bus", "The bus", "twin/transport/BUS.md"),
            _page("extend", "Add a test, an effect, a backend"),
        ),
    ),
)


def build_guide(folder: Path, program: TyperGroup, chapters: Sequence[Chapter] = CHAPTERS) -> Path:
    """Write all pages to `folder`, replacing an older guide; return the path of the first page.

    InputError if the folder holds anything else, or lists every link that leads nowhere.
    """
    pages = [page for chapter in chapters for page in chapter.pages]
    _prepare_folder(folder, folder / pages[0].file_name)
    links = _PageLinks(pages, folder)
    rendered = {page: links.render(page, page.read(program)) for page in pages}
    faults = links.find_broken(rendered)
    if faults:
        raise InputError("broken links", where="guide", faults=faults)
    # Of its own: the pages of reports import kernels, which are not compiled for a guide.
    template = Environment(
        loader=FileSystemLoader(Path(__file__).parent),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    ).get_template("guide.html")
    for page, following in zip(pages, [*pages[1:], None], strict=True):
        html = template.render(
            page=page,
            body=Markup(rendered[page].html),
            headings=[heading for heading in rendered[page].headings if heading.level == 2],
            chapters=chapters,
            following=following,
        )
        (folder / page.file_name).write_text(html, encoding="utf-8")
    sections = [section for page in pages for section in _split_sections(page, rendered[page])]
    script = (Path(__file__).parent / SEARCH_FILE).read_text(encoding="utf-8")
    index = f"const sections = {json.dumps(sections)};\n"
    (folder / SEARCH_FILE).write_text(index + script, encoding="utf-8")
    return folder / pages[0].file_name


def _split_sections(page: GuidePage, rendered: RenderedMarkdown) -> Iterator[tuple[str, ...]]:
    """Yield (link, title of the page, heading, text) of each section of a page."""
    parts = re.split(r'<h[1-3] id="([^"]*)">(.*?)</h[1-3]>', rendered.html, flags=re.DOTALL)
    for anchor, heading, body in zip(
        ["", *parts[1::3]], ["", *parts[2::3]], parts[::3], strict=True
    ):
        words = [" ".join(Markup(text).striptags().split()) for text in (heading, body)]
        if any(words):
            yield f"{page.file_name}#{anchor}", page.title, *words


def _prepare_folder(folder: Path, first_page: Path) -> None:
    """Create the folder of a guide; InputError if it has content and is no guide."""
    is_guide = first_page.is_file() and GUIDE_MARK in first_page.read_text(
        encoding="utf-8", errors="replace"
    )
    if folder.exists() and not is_guide and (not folder.is_dir() or any(folder.iterdir())):
        raise InputError(
            "exists and is no guide; nothing is overwritten",
            key="--out",
            value=str(folder),
            remedy="give a new folder",
        )
    folder.mkdir(parents=True, exist_ok=True)


class _PageLinks:
    """Resolution of links between Markdown files to links between pages."""

    def __init__(self, pages: Sequence[GuidePage], folder: Path) -> None:
        self._by_path = {page.markdown_path: page for page in pages}
        self._folder = folder
        self._unresolved: dict[GuidePage, list[str]] = {}
        self._anchors: list[tuple[GuidePage, GuidePage, str]] = []  # from, to, anchor

    def render(self, page: GuidePage, text: str) -> RenderedMarkdown:
        """Render the Markdown of a page."""
        return render_markdown(
            text,
            lambda target: self._resolve_link(page, target),
            lambda name: self._resolve_code(page, name),
        )

    def find_broken(self, rendered: dict[GuidePage, RenderedMarkdown]) -> list[InputError]:
        """Return an error for each target and each anchor that does not exist."""
        faults = [
            InputError("no such page or file", where=page.slug, value=target)
            for page, targets in self._unresolved.items()
            for target in targets
        ]
        for source, page, anchor in self._anchors:
            if all(heading.anchor != anchor for heading in rendered[page].headings) and (
                f'id="{anchor}"' not in rendered[page].html
            ):
                faults.append(
                    InputError(
                        "no such heading", where=source.slug, value=f"{page.file_name}#{anchor}"
                    )
                )
        return faults

    def _resolve_link(self, page: GuidePage, target: str) -> str:
        parts = urlsplit(target)
        if parts.scheme:
            return target
        path = page.markdown_path
        if parts.path:
            path = Path(os.path.normpath(page.markdown_path.parent / parts.path))
        linked = self._by_path.get(path)
        if path.is_file() and path.suffix != ".md" and (linked in (None, page)):
            files = self._folder / FILES_FOLDER
            files.mkdir(exist_ok=True)
            shutil.copyfile(path, files / path.name)
            return f"{FILES_FOLDER}/{path.name}"
        if linked is None:
            self._unresolved.setdefault(page, []).append(target)
            return target
        if parts.fragment:
            self._anchors.append((page, linked, parts.fragment))
        name = linked.file_name if linked is not page or not parts.fragment else ""
        return f"{name}#{parts.fragment}" if parts.fragment else name

    def _resolve_code(self, page: GuidePage, name: str) -> str:
        """Return the href of a page that a text names by the path of its file, else ""."""
        if not name.endswith(".md"):
            return ""
        for path in (PACKAGES_DIR / name, page.markdown_path.parent / name):
            linked = self._by_path.get(Path(os.path.normpath(path)))
            if linked is not None and linked is not page:
                return linked.file_name
        return ""
