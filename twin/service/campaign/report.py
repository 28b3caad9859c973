"""report.html, summary.json and figures/ of a whole campaign, written anew from its folder."""

from hashlib import sha256
from pathlib import Path

from twin.service import summary as summaries
from twin.service.campaign.pictures import draw_all, gap_name
from twin.service.campaign.whole import Whole, read_whole
from twin.service.figures import Picture
from twin.service.page import inside, page


def write_whole(folder: Path) -> Path:
    """Path of folder/report.html; summary.json and figures/ beside it."""
    whole = read_whole(folder)
    summaries.write(whole.summary, folder / "summary.json")
    pictures = draw_all(whole, folder / "figures")
    path = folder / "report.html"
    path.write_text(render(whole, pictures), encoding="utf-8")
    return path


def render(whole: Whole, pictures: list[Picture]) -> str:
    """The page, with every picture inside it; links lead to the reports of the runs beside it."""
    text = (whole.folder / "campaign.toml").read_text(encoding="utf-8")
    return page(
        Path(__file__).with_name("campaign.html"),
        summary=whole.summary,
        state=whole.state,
        runs=list(zip(whole.summary["runs"], whole.runs, strict=True)),
        stars=whole.stars,
        images=inside(pictures),
        gap_name=gap_name,
        text=text,
        digest=sha256(text.encode()).hexdigest(),
    )
