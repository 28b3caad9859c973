"""Markdown to HTML: tables, anchors, formulas as MathML, links between pages; notebooks too."""

import json
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from html import escape
from itertools import pairwise
from typing import Any

from latex2mathml.converter import convert
from markdown_it import MarkdownIt
from markdown_it.token import Token
from mdit_py_plugins.anchors import anchors_plugin
from mdit_py_plugins.deflist import deflist_plugin
from mdit_py_plugins.dollarmath import dollarmath_plugin

MAX_TOC_LEVEL = 3  # of the headings that get an anchor
LinkResolver = Callable[[str], str]  # target in the Markdown -> href in the page


@dataclass(frozen=True, slots=True)
class Heading:
    """Heading of a page with its anchor."""

    level: int
    text: str
    anchor: str


@dataclass(frozen=True, slots=True)
class RenderedMarkdown:
    """HTML of a text, and its headings."""

    html: str
    headings: tuple[Heading, ...]


def slugify(text: str) -> str:
    """Return the anchor of a heading, as common Markdown viewers make it."""
    return re.sub(r"\s", "-", re.sub(r"[^\w\s-]", "", text.strip().lower()))


def render_markdown(
    text: str, resolve_link: LinkResolver, resolve_code: LinkResolver
) -> RenderedMarkdown:
    """Render Markdown; `resolve_code` returns the href of a name in code style, "" for none."""
    renderer = MarkdownIt("commonmark", {"html": True}).enable("table")
    renderer.use(anchors_plugin, max_level=MAX_TOC_LEVEL, slug_func=slugify)
    renderer.use(deflist_plugin)
    renderer.use(dollarmath_plugin, allow_digits=False, renderer=_render_formula, allow_space=False)
    tokens = renderer.parse(text)
    for token in tokens:
        _resolve_links(token.children or [], resolve_link, resolve_code)
    html = renderer.renderer.render(tokens, renderer.options, {})
    html = html.replace("<table>", '<div class="wide"><table>').replace(
        "</table>", "</table></div>"
    )
    return RenderedMarkdown(html, tuple(_list_headings(tokens)))


def _render_formula(formula: str, options: dict[str, Any]) -> str:
    return convert(formula, display="block" if options["display_mode"] else "inline")


def _resolve_links(
    tokens: list[Token], resolve_link: LinkResolver, resolve_code: LinkResolver
) -> None:
    """Replace the targets of links and pictures; link the names of pages in code style."""
    depth = 0
    for token in tokens:
        for attribute in ("href", "src"):
            if attribute in token.attrs:
                token.attrs[attribute] = resolve_link(str(token.attrs[attribute]))
        depth += token.nesting if token.type in ("link_open", "link_close") else 0
        if token.type == "code_inline" and not depth and (href := resolve_code(token.content)):
            code = f"<code>{escape(token.content)}</code>"
            token.type, token.content = "html_inline", f'<a href="{escape(href)}">{code}</a>'


def _list_headings(tokens: list[Token]) -> list[Heading]:
    return [
        Heading(
            int(token.tag[1]),
            "".join(
                child.content
                for child in content.children or []
                if child.type in ("text", "code_inline")
            ),
            str(token.attrs.get("id", "")),
        )
        for token, content in pairwise(tokens)
        if token.type == "heading_open"
    ]


def convert_notebook(text: str, name: str) -> str:
    """Return a notebook as Markdown; `name` is its file, which the page links."""
    cells = json.loads(text)["cells"]
    parts = [part for cell in cells for part in _convert_cell(cell)]
    parts.insert(1, f"This page is the notebook [{name}]({name}): download it and run it.")
    return "\n\n".join(parts)


def _convert_cell(cell: dict[str, Any]) -> Iterator[str]:
    source = "".join(cell["source"])
    if cell["cell_type"] != "code":
        # The title is a part of its own.
        yield from source.split("\n\n", 1) if source.startswith("# ") else [source]
        return
    yield f"```python\n{source}\n```"
    texts = [
        "".join(output.get("text") or output["data"].get("text/plain", ""))
        for output in cell["outputs"]
    ]
    if text := "".join(texts).rstrip():
        yield f"```text\n{text}\n```"
    for output in cell["outputs"]:
        if image := "".join(output.get("data", {}).get("image/png", "")).replace("\n", ""):
            yield f'<p><img alt="Figure of this cell" src="data:image/png;base64,{image}"></p>'
