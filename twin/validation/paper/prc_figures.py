"""PRC families of the paper (Figs. 2 and 5)."""

from twin.reports.measured_campaign import MeasuredCampaign
from twin.reports.plot_style import PaperFigures
from twin.reports.prc_families import draw_all_gaps, draw_transition
from twin.validation.paper.study import PaperStudy


def draw_prc_figures(study: PaperStudy, campaign: MeasuredCampaign | None) -> PaperFigures:
    """Draw Figs. 2 and 5; with a campaign, its measured points on the model's curves."""
    yield draw_all_gaps(study.cases, campaign)
    yield draw_transition(study.cases, campaign)
