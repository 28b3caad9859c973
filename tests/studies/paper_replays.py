"""Every profile of the paper recorded and replayed: equal to the bit, or by how much not.

    python -m tests.studies.paper_replays OUT [PROFILE...]       unpaced, all twelve
    python -m tests.studies.paper_replays OUT --live             live, three frequencies of each
    python -m tests.studies.paper_replays OUT --logs LOG...      recordings of any commit

Appends a line a replay to OUT/study.csv and leaves out what stands there already, so that it can be
stopped and gone on with. Not part of the test run: the twelve profiles are two hours of test time.
"""

import csv
import re
import shutil
import sys
import time
from pathlib import Path

from table_io.config.base import PROFILES_DIR
from twin.live.run_command import run_test
from twin.recording.run_paths import resolve_log_path
from twin.replay.pipeline_replay import RecordedRun, replay_recording
from twin.results.recordings import read_recorded_config
from twin.setup.run_config import read_run_config
from twin.setup.unpaced import play_unpaced
from twin.setup.warm_up import compile_kernels

COLUMNS = (
    "log", "how", "samples", "compared", "differing", "missing", "identical", "open_s", "replay_s",
    "times_real_time",
)  # fmt: skip
PAPER = (
    "quickstart", "ginf", "g30", "g16", "g10", "g4_ss1", "g4_ss2", "g4_ss3", "g0", "gm1", "gm2",
    "gm10",
)  # fmt: skip
LIVE_SWEEP = {"start_hz": 3.2, "stop_hz": 3.8, "step_hz": 0.3, "cycles": 6}


def again(log: Path, how: str, folder: Path) -> dict[str, object]:
    """One line of the study: a log replayed, with the CPU time that it took."""
    began = time.process_time()
    recorded = RecordedRun.open(log)
    opened = time.process_time()
    bundle = read_recorded_config(recorded.recording)
    compile_kernels(bundle)
    made = folder / "again.mcap"
    made.unlink(missing_ok=True)
    ready_at = time.process_time()
    identity = replay_recording(recorded, bundle, made, "again", lambda _: None)
    ended = time.process_time()
    made.unlink()
    stop = recorded.recording.stop
    samples = stop.index if stop else 0
    seconds = opened - began + ended - ready_at
    values = (
        log.parent.name, how, samples, identity.compared, identity.differing,
        identity.missing + identity.unrecorded, identity.is_identical, round(opened - began, 2),
        round(ended - ready_at, 2), round(samples / recorded.start.rate_hz / seconds, 1),
    )  # fmt: skip
    return dict(zip(COLUMNS, values, strict=True))


def recorded_log(profile: Path, folder: Path, live: bool) -> Path:
    """The log of a test, driven now: unpaced as it is, live from its first frequencies only."""
    out = folder / profile.stem
    shutil.rmtree(out, ignore_errors=True)
    if live:
        text = profile.read_text()
        for key, value in LIVE_SWEEP.items():
            text = re.sub(rf"^{key} = .*$", f"{key} = {value}", text, flags=re.MULTILINE)
        short = folder / f"{profile.stem}.toml"
        folder.mkdir(parents=True, exist_ok=True)
        short.write_text(text)
        assert run_test(short, out, False, None, None, False, "tcp/127.0.0.1:7561") in (0, 4)
        return out / "run.mcap"
    bundle = read_run_config(profile)
    compile_kernels(bundle, table=True)
    out.mkdir(parents=True)
    play_unpaced(bundle, profile.stem, out / "run.mcap", lambda: None, lambda _: None)
    return out / "run.mcap"


def main(out: Path, what: list[str]) -> int:
    """Exit code 1 where a replay was not identical."""
    out.mkdir(parents=True, exist_ok=True)
    table = out / "study.csv"
    done = list(csv.DictReader(table.open())) if table.exists() else []
    live, logs = "--live" in what, "--logs" in what
    names = [argument for argument in what if not argument.startswith("--")]
    how = "live" if live else "as recorded" if logs else "unpaced"
    every = [PROFILES_DIR / "tests" / f"{name}.toml" for name in PAPER]
    sources = [Path(name) for name in names] if logs else [
        path for path in every if not names or path.stem in names
    ]  # fmt: skip
    for source in sources:
        name = resolve_log_path(source).parent.name if logs else source.stem
        if any((row["log"], row["how"]) == (name, how) for row in done):
            continue
        log = resolve_log_path(source) if logs else recorded_log(source, out / how, live)
        row = again(log, how, out)
        with table.open("a", newline="") as file:
            writer = csv.DictWriter(file, COLUMNS)
            if not done:
                writer.writeheader()
            writer.writerow(row)
        done.append({key: str(value) for key, value in row.items()})
        print(*row.values(), flush=True)
        if not logs:
            shutil.rmtree(out / how)
    return int(any(row["identical"] != "True" for row in done))


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1]), sys.argv[2:]))
