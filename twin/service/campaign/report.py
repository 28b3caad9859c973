"""report.html, summary.json and figures/ of a whole campaign, written anew from its folder."""

import base64
from hashlib import sha256
from pathlib import Path

from jinja2 import Environment, FileSystemLoader, StrictUndefined

from twin.service import summary as summaries
from twin.service.campaign.pictures import draw_all, gap_name
from twin.service.campaign.whole import Whole, read_whole
from twin.service.figures import Picture
from twin.service.report import significant


def write_whole(folder: Path) -> Path:
    """Path of folder/report.html; summary.json and figures/ beside it."""
    whole = read_whole(folder)
    summaries.write(whole.summary, folder / "summary.json")
    pictures = draw_all(whole, folder / "figures")
    page = folder / "report.html"
    page.write_text(render(whole, pictures), encoding="utf-8")
    return page


def render(whole: Whole, pictures: list[Picture]) -> str:
    """The page, with every picture inside it; links lead to the reports of the runs beside it."""
    environment = Environment(
        loader=FileSystemLoader(Path(__file__).parent),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["sig"] = significant
    text = (whole.folder / "campaign.toml").read_text(encoding="utf-8")
    return environment.get_template("campaign.html").render(
        summary=whole.summary,
        state=whole.state,
        runs=list(zip(whole.summary["runs"], whole.runs, strict=True)),
        stars=whole.stars,
        images=[(one, base64.b64encode(one.path.read_bytes()).decode()) for one in pictures],
        gap_name=gap_name,
        text=text,
        digest=sha256(text.encode()).hexdigest(),
    )
