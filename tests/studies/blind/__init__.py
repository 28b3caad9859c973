"""Blind validation study of discovery: simulated cases with sealed ground truth, scored verdicts.

`strata` draws a case from its number, `amplitude_search` scales its effect to the required
residual, `generation` simulates and records it, and `adapter` runs discovery. `evaluation` and
`scoring` compare the verdict with the truth, `rates` and `report` summarize. `command` runs the
cases on several processes (`twin.system.process_pool`) and can resume. Baseline methods and
negative controls run on the same recordings.
"""
