"""Campaigns: a list of runs with set-up changes between them, resumed where it stopped.

The folder of a campaign:
    campaign.toml    the campaign's file as it was when it began
    campaign.json    what is done, where, and what the operator did; replaced as a whole
    cards/NN-label/  profile, machine card and model of each run as they were when it began
    NN-label/        a run; NN-label-2, -3 go on with one that was interrupted
    summary.json, report.html, figures/   of the whole
"""
