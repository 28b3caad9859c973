"""Campaigns: a list of runs with set-up changes between them, resumable after an interruption.

The folder of a campaign:
    campaign.toml    copy of the campaign file, made at the start
    campaign.json    state: status and recordings of each run, operator answers; replaced atomically
    cards/NN-label/  copies of the profile, rig config and model of each run, made at the start
    NN-label/        a run; NN-label-2, -3 continue one that was interrupted
    summary.json, report.html, figures/   of the whole campaign
"""

STATE_FILE = "campaign.json"
