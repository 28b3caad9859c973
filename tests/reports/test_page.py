"""Rendering of pages: compiled templates are kept, and never shown for another text."""

from pathlib import Path

import pytest

from twin.drawing import page


def test_a_template_that_was_compiled_before_follows_its_text(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(page, "CACHE_DIR", tmp_path / "cache")
    template = tmp_path / "page.html"
    for text in ("{{ value }} mm", "{{ value }} mm", "{{ 2 * value }} mm"):
        template.write_text(text)
        rendered = page.render_page(template, value=4)
    assert rendered == "8 mm"
    assert len([*(tmp_path / "cache").iterdir()]) == 1


def test_a_page_is_rendered_where_no_cache_can_be_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setattr(page, "CACHE_DIR", tmp_path / "file" / "cache")
    template = tmp_path / "page.html"
    template.write_text("{{ value }} mm")
    assert page.render_page(template, value=4) == "4 mm"
