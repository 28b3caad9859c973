"""The plant of a case: its sealed truth, the tests that it plays, and the files of the study.

    cases/<label>   log.mcap  profile.toml  model.toml
    sealed/<label>  truth.toml  about.json

The recording comes from an ordinary session on the simulated table at maximum speed. It contains
the nominal values and the SHA-256 of the sealed file, which is salted.
"""

import json
import math
import shutil
import tempfile
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from table_io.acquisition.session import TARE_S, RunDescriber
from table_io.backends import Backend, open_backend
from table_io.block import Block
from table_io.clock import ManualClock
from table_io.config.base import format_toml
from table_io.config.calibration import compute_tare, volts_to_si
from table_io.config.profile import Profile
from table_io.records import Record, RunStop
from table_io.sim.imperfections import SIDES, Imperfection, resolve_sides
from tests.builders.rigs import read_rig_text
from tests.studies.blind.cases import Case, PlantedEffect
from tests.studies.blind.laboratory_truth import (
    compute_setup_errors,
    list_affected_channels,
    list_true_errors,
    measure_visible_size,
)
from tests.studies.blind.rig import (
    MODEL_TOML,
    PROFILE,
    PROFILE_TOML,
    SIGNAL_CHANNELS,
    StudySignals,
    compute_noise_rms,
    make_rig_toml,
    simulate_readings,
    simulate_signals,
)
from tests.studies.blind.sizes import (
    BaselineResidual,
    apply_sensor_effect,
    evaluate_residual,
    find_share,
    scale_parameters,
)
from twin.recording.mcap_log import write_items
from twin.setup.run_config import RunConfig, from_texts
from twin.setup.unpaced import iter_simulated_session

TRUTH_DIGITS = 6  # significant digits of a number in the truth
# Base parameter of a case -> key of a truth, and of the nominal rig.
BASE_KEYS = {
    "damper_stiffness": "damper_stiffness_n_m",
    "damper_damping": "damper_damping_n_s_m",
    "bumper_stiffness": "bumper_stiffness_n_m",
    "bumper_damping": "bumper_damping_n_s_m",
}


@dataclass(frozen=True, slots=True)
class CasePaths:
    """Folders and files of a case: discovery may read `case_dir`, the truth is in `sealed_dir`."""

    root: Path
    label: str

    @property
    def case_dir(self) -> Path:
        return self.root / "cases" / self.label

    @property
    def sealed_dir(self) -> Path:
        return self.root / "sealed" / self.label

    @property
    def log(self) -> Path:
        return self.case_dir / "log.mcap"

    @property
    def verdict(self) -> Path:
        return self.case_dir / "verdict.json"

    @property
    def truth(self) -> Path:
        return self.sealed_dir / "truth.toml"

    @property
    def about(self) -> Path:
        """Path of the description of the case, for scoring."""
        return self.sealed_dir / "about.json"

    def clear(self) -> None:
        """Make both folders, empty: what an interrupted study left of the case is removed."""
        for folder in (self.case_dir, self.sealed_dir):
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir(parents=True)


class SealedPlant:
    """The plant of a case on a rig: it plays any test, each with noise of its own.

    On another rig than `simulated` the truth also states the instruments of that rig.
    """

    def __init__(self, case: Case, truth: Path, rig: str = "simulated") -> None:
        self.case, self._truth, self._rig, self._tests = case, truth, rig, 0
        if rig != "simulated":
            hidden = tomllib.loads(read_rig_text(rig))["simulated"]["hidden"]
            self._truth = truth.with_name(f"truth_{rig}.toml")
            text = truth.read_text(encoding="utf-8") + "\n" + format_toml(hidden)
            self._truth.write_text(text, encoding="utf-8")

    @classmethod
    def seal(cls, case: Case, truth: Mapping[str, Any], path: Path) -> "SealedPlant":
        """Write a truth, salted, and return the plant that has it."""
        path.write_text(f"# {case.salt}\n" + format_toml(truth), encoding="utf-8")
        return cls(case, path)

    def make_rig(self, noise: float, seed: int = 0) -> str:
        """Return the config of its rig, which names the truth by its hash."""
        return make_rig_toml(noise, seed, self._truth, self._rig)

    def record(
        self, log: Path, is_protected: bool = True, profile_toml: str = PROFILE_TOML
    ) -> RunStop:
        """Record a test, by default the study's; return its end."""
        log.parent.mkdir(parents=True, exist_ok=True)
        log.unlink(missing_ok=True)
        rig = self.make_rig(self.case.cell.noise, self.case.noise_seed + self._tests)
        self._tests += 1
        return record_test(rig, self.case.label, log, is_protected, profile_toml)

    def simulate(self, profile: Profile = PROFILE) -> StudySignals:
        """Return the true signals of a test."""
        return simulate_signals(self.make_rig(0.0), profile)


def generate_case(case: Case, root: Path) -> CasePaths:
    """Generate the files of a case, unless they exist; return their paths.

    `about.json` is written last: a case without it is incomplete and is generated again.
    """
    paths = CasePaths(root, case.label)
    if paths.about.is_file():
        return paths
    paths.clear()
    shares, residual = find_shares(case)
    truth = make_truth(case, case.planted, shares)
    if case.imperfections:
        truth["imperfections"] = [*map(_describe_imperfection, case.imperfections)]
    plant = SealedPlant.seal(case, truth, paths.truth)
    outcome = f"not played: the effect reaches size {residual.size:.3g}"
    if case.cell.accepts(residual.size):
        outcome = describe_end(plant.record(paths.log, not case.imperfections))
    (paths.case_dir / "profile.toml").write_text(PROFILE_TOML, encoding="utf-8")
    (paths.case_dir / "model.toml").write_text(MODEL_TOML, encoding="utf-8")
    about = {
        "number": case.number,
        "cell": case.cell.name,
        "kind": case.cell.kind,
        "noise": case.cell.noise,
        "size": case.cell.size,
        "reached": residual.size,
        "ended": outcome,
        "sized": outcome == "complete",
        "region": residual.region if case.planted else None,
        "base": _describe_base(truth["base"], case.imperfections),
        "effects": [
            _describe_effect(planted, share, compute_setup_errors(case.imperfections))
            for planted, share in zip(case.planted, shares, strict=True)
        ],
    }
    if case.imperfections:
        about["laboratory"] = _describe_laboratory(plant)
    paths.about.write_text(json.dumps(about, indent=1), encoding="utf-8")
    return paths


def describe_end(stop: RunStop) -> str:
    """Return how a test ended, with the reason unless it is complete."""
    return stop.verdict if stop.verdict == "complete" else f"{stop.verdict}: {stop.reason}"


def _describe_base(
    base: dict[str, float], imperfections: Sequence[Imperfection]
) -> dict[str, float]:
    """Return the true base parameters for scoring: gaps with the errors of their readings."""
    readings = resolve_sides(imperfections, "gap_reading")
    gaps = {
        f"gap_{side}_m": base[f"gap_{side}_m"] + readings.get(side, {}).get("offset", 0.0)
        for side in SIDES
    }
    return base | gaps | {"stated_gap_m": 0.5 * sum(PROFILE.specimen.gaps_m)}


def _describe_imperfection(imperfection: Imperfection) -> dict[str, Any]:
    """Return an entry of [[imperfections]]; infinite parameters are at their vanishing value."""
    place = {
        key: value
        for key, value in (("channel", imperfection.channel), ("side", imperfection.side))
        if value is not None
    }
    return {
        "id": imperfection.id, "form": imperfection.form, **place,
        "parameters": _round_values(imperfection.parameters),
    }  # fmt: skip


def _describe_laboratory(plant: SealedPlant) -> dict[str, Any]:
    """Return the laboratory of a case for scoring, with the errors that a verdict may name."""
    case = plant.case
    signals, readings = simulate_readings(plant.make_rig(0.0, case.noise_seed))
    return {
        "level": case.cell.laboratory,
        "imperfection": case.cell.imperfection,
        "size": measure_visible_size(signals, readings, compute_noise_rms(case.cell.noise)),
        "imperfections": [*map(_describe_imperfection, case.imperfections)],
        "channels": list_affected_channels(case.imperfections, SIGNAL_CHANNELS),
        "errors": list_true_errors(case.imperfections, signals, readings),
    }


def _describe_effect(
    planted: PlantedEffect, share: float, set_up: Mapping[str, Mapping[str, float]]
) -> dict[str, Any]:
    """Return the description of a planted effect for scoring.

    An error of the set-up by the laboratory adds to a planted one; ratios multiply.
    """
    parameters = scale_parameters(planted, share)
    for name, error in set_up.get(planted.effect.name, {}).items():
        total = parameters[name] * error if name == "ratio" else parameters[name] + error
        parameters[name] = total
    return {
        "name": planted.effect.name,
        "form": planted.effect.definition.form,
        "parameters": _round_values(parameters),
        "vanishing": {
            parameter.name: parameter.vanishing for parameter in planted.effect.amplitudes
        },
    }


def make_truth(
    case: Case, planted_effects: Sequence[PlantedEffect], shares: Sequence[float]
) -> dict[str, Any]:
    """Return the content of the sealed file: scattered base parameters and planted effects."""
    nominal = tomllib.loads(read_rig_text("simulated"))["simulated"]
    base = {key: case.base[name] * nominal[key] for name, key in BASE_KEYS.items()}
    for side, gap in zip(("right", "left"), PROFILE.specimen.gaps_m, strict=True):
        base[f"gap_{side}_m"] = case.base["gap"] * gap
    effects = [
        {"id": planted.effect.definition.id, "form": planted.effect.definition.form}
        | ({"channel": planted.effect.channel} if planted.effect.channel else {})
        | {"parameters": _round_values(scale_parameters(planted, share))}
        for planted, share in zip(planted_effects, shares, strict=True)
    ]
    return {"base": _round_values(base)} | ({"effects": effects} if effects else {})


def find_shares(case: Case) -> tuple[list[float], BaselineResidual]:
    """Return the share at which each effect alone has the cell's size, and the residual of all."""
    noise = compute_noise_rms(case.cell.noise)

    @cache
    def base_signals() -> StudySignals:
        """Simulate once: sensor effects do not change the true signals."""
        return simulate_truth(case, [], [])

    def compute_residual(
        planted_effects: Sequence[PlantedEffect], shares: Sequence[float]
    ) -> BaselineResidual:
        sensors = [planted.effect.definition.is_sensor_effect for planted in planted_effects]
        readings = signals = (
            base_signals() if all(sensors) else simulate_truth(case, planted_effects, shares)
        )
        for planted, share in zip(planted_effects, shares, strict=True):
            readings = apply_sensor_effect(planted, share, readings)
        return evaluate_residual(readings, signals, noise)

    def find_share_alone(planted: PlantedEffect) -> tuple[float, BaselineResidual]:
        return find_share(
            planted, case.cell.size, lambda share: compute_residual([planted], [share])
        )

    searches = [find_share_alone(planted) for planted in case.planted]
    shares = [share for share, _ in searches]
    return shares, searches[0][1] if len(searches) == 1 else compute_residual(case.planted, shares)


def simulate_truth(
    case: Case, planted: Sequence[PlantedEffect], shares: Sequence[float]
) -> StudySignals:
    """Return the true signals of the study's test with effects of these shares."""
    with tempfile.TemporaryDirectory() as folder:
        truth = make_truth(case, planted, shares)
        return SealedPlant.seal(case, truth, Path(folder) / "truth.toml").simulate()


def record_test(
    rig: str, label: str, log: Path, is_protected: bool, profile_toml: str = PROFILE_TOML
) -> RunStop:
    """Record a test, by default the study's, on the machine of a rig config; return its end."""
    bundle = from_texts("case", profile_toml, rig, MODEL_TOML, f"case {label}")
    if is_protected:
        start, *rest = iter_simulated_session(bundle, label)
    else:
        backend = open_backend(bundle.rig, bundle.profile, ManualClock())
        start, *rest = play_unprotected(bundle, backend, bundle.make_start_factory(label, "table"))
    assert not isinstance(start, RunStop)
    write_items(log, [start, *rest], start)  # type: ignore[arg-type]
    stop = rest[-1]
    assert isinstance(stop, RunStop)
    return stop


def play_unprotected(
    bundle: RunConfig, backend: Backend, describe: RunDescriber
) -> Iterator[Block | Record]:
    """Yield RunStart, the blocks of the whole drive and RunStop, as a session without protection.

    In an imperfect laboratory the protection would end the test of what discovery is to judge.
    """
    rig, acquisition, drive = bundle.rig, bundle.profile.acquisition, bundle.drive
    backend.open()
    tare = compute_tare(backend.tare(int(TARE_S * acquisition.rate_hz)), rig.sensors)
    end = drive.rest_start + round(acquisition.rest_s * acquisition.rate_hz)
    backend.queue(0, drive.command(0, end) * rig.output.volts_per_m)
    backend.start()
    yield describe(tare, backend.scheduled_time_s(0))
    for first in range(0, end, acquisition.block_samples):
        count = min(acquisition.block_samples, end - first)
        values = volts_to_si(backend.read(count), rig.sensors, tare)
        labels = drive.labels(first, count)
        yield Block("meas", first, acquisition.rate_hz, rig.channels, values, *labels)
    backend.close()
    yield RunStop(end, "complete", "the whole drive was played")


def _round_values(values: dict[str, float]) -> dict[str, float]:
    return {
        name: float(f"{value:.{TRUTH_DIGITS}g}")
        for name, value in values.items()
        if math.isfinite(value)
    }
