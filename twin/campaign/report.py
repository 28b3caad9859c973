"""Write report.html, summary.json and figures/ of a campaign from the files in its folder."""

from hashlib import sha256
from pathlib import Path

from twin.campaign.figures import draw_campaign_figures, format_gap
from twin.campaign.summary import CampaignData, read_campaign
from twin.reports import summary as summaries
from twin.reports.page import embed_images, render_page
from twin.reports.plot_style import Picture


def write_campaign_report(folder: Path) -> Path:
    """Write summary.json, figures/ and report.html; return the path of report.html."""
    campaign = read_campaign(folder)
    summaries.write_json(campaign.summary, folder / "summary.json")
    pictures = draw_campaign_figures(campaign, folder / "figures")
    path = folder / "report.html"
    path.write_text(render_campaign_report(campaign, pictures), encoding="utf-8")
    return path


def render_campaign_report(campaign: CampaignData, pictures: list[Picture]) -> str:
    """Return the HTML page with embedded figures and relative links to the reports of the runs."""
    text = (campaign.folder / "campaign.toml").read_text(encoding="utf-8")
    return render_page(
        Path(__file__).with_name("campaign.html"),
        summary=campaign.summary,
        state=campaign.state,
        runs=list(zip(campaign.summary["runs"], campaign.runs, strict=True)),
        stars=campaign.stars,
        reports={path.parent.name for path in campaign.folder.glob("*/report.html")},
        images=embed_images(pictures),
        gap_name=format_gap,
        text=text,
        digest=sha256(text.encode()).hexdigest(),
    )
