"""Notebooks of the tutorials as Markdown, with the outputs that are stored in them."""

import json
from collections.abc import Iterator
from typing import Any


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
