"""Task: the model alone on the ideal drive of a test."""

from pathlib import Path

from twin.log import Log, open_log
from twin.report.finalize import write_results
from twin.setup.folders import make_run_folder
from twin.setup.run_config import read_run_config
from twin.setup.unpaced import Observe, ShownRun, observe_nothing, simulate_ideal
from twin.setup.warm_up import compile_kernels


def simulate(
    profile: str | Path,
    out: str | Path | None = None,
    model: str | Path | None = None,
    view: bool = False,
    observe: Observe = observe_nothing,
) -> Log:
    """Simulate the model alone on the ideal drive of a test; return its log in folder `out`.

    The table follows the drive exactly and there is no noise: `log.twin` has the response,
    `log.prc["twin_eta_d"]` and others the curves, (point,). Writes summary and report, with `view`
    view.rrd. InputError for a faulty profile or model.
    """
    config = read_run_config(Path(profile), None, None if model is None else str(model))
    compile_kernels(config)
    folder, run = make_run_folder(None if out is None else Path(out), f"{config.name}-model")
    with observe(ShownRun(config, run, 0, config.drive.planned_end)) as on_item:
        simulate_ideal(config, run, folder / "run.mcap", on_item)
    write_results(folder, config, view)
    return open_log(folder)
