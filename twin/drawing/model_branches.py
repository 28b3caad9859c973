"""Branches of the model of a run, for its report."""

from twin.drawing.branch_curves import BranchSet
from twin.dynamics.main_branches import follow_sweep_branches
from twin.results.report_data import ReportData, read_initial_model


def follow_model_branches(run: ReportData) -> BranchSet | None:
    """Follow the main branches of the model over the steps of a run; None without any."""
    model, steps = read_initial_model(run), run.recording.start.steps
    if model is None or run.summary.stars is None:
        return None
    branches = follow_sweep_branches(
        model,
        (step.frequency_hz for step in steps),
        (step.acceleration_m_s2 for step in steps),
    )
    return BranchSet(branches) if branches else None
