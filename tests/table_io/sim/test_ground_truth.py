"""The sealed truth: what can be hidden, that it stays sealed, and what sensors make of it."""

import hashlib
import struct
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from table_io.block import Float1D, Float2D
from table_io.clock import ManualClock
from table_io.config.base import PROFILES_DIR, load_config, parse_toml
from table_io.config.calibration import compute_tare, volts_to_si
from table_io.config.rig import RigConfig
from table_io.errors import InputError
from table_io.sim.config import SimulatedTableConfig
from table_io.sim.ground_truth import (
    DEFINITION_BY_ID,
    EFFECT_DEFINITIONS,
    GroundTruth,
    parse_ground_truth,
)
from table_io.sim.simulated_table import SensorDistortion, SimulatedBackend
from tests.builders.profiles import AT_1_KHZ, SPECIMEN, UNCHECKED, format_test
from tests.builders.truths import seal_truth
from tests.input_errors import raises_input_error
from twin.laws.library import EFFECTS
from twin.recording.reader import read_recording
from twin.recording.recovery import recover_log
from twin.results.recordings import read_recorded_config
from twin.setup.run_config import read_run_config
from twin.setup.unpaced import play_unpaced

CARD, CARD_TOML = load_config(PROFILES_DIR / "rigs" / "simulated.toml", RigConfig, "machine card")
RATE_HZ = 2000.0
ACC = CARD.channels.index("mass_acc_m_s2")
PHYSICS = """
[base]
damper_stiffness_n_m = 36741.5
[[effects]]
id = "bouc_wen"
parameters = { force = 151.37, yield_displacement = 2.9173e-3 }
[[effects]]
id = "gap_drift"
parameters = { rate = 4.8231e-6 }
"""


def machine(folder: Path, text: str | None, **sensor: float) -> SimulatedBackend:
    """An open machine, with a truth where there is a text, sensors changed alike."""
    raw = CARD.model_dump()
    raw["simulated"].update(seal_truth(folder, text) if text is not None else {})
    for entry in raw["sensors"]:
        entry.update(sensor)
    backend = SimulatedBackend(RigConfig.model_validate(raw), SPECIMEN, RATE_HZ, ManualClock())
    backend.open()
    return backend


def acquire_run(backend: SimulatedBackend, cuts: list[int]) -> Float2D:
    """Volts of a run at 1.4 Hz with impacts, in blocks of `cuts`."""
    t = np.arange(sum(cuts)) / RATE_HZ
    metres = 6e-3 * np.minimum(t, 1.0) ** 3 * np.sin(2 * np.pi * 1.4 * t)
    backend.queue(0, metres * CARD.output.volts_per_m)
    backend.start()
    return np.concatenate([backend.read(samples) for samples in cuts], axis=1)


PARAMETERS = "effects.0.parameters"


def effect(name: str, channel: str | None = None, **parameters: float) -> str:
    """One entry of [[effects]]."""
    where = f'channel = "{channel}"\n' if channel else ""
    numbers = ", ".join(f"{key} = {value}" for key, value in parameters.items())
    return f'[[effects]]\nid = "{name}"\n{where}parameters = {{ {numbers} }}\n'


def test_effects_match_those_of_the_model() -> None:
    kinds = {kind.id: kind for kind in EFFECT_DEFINITIONS if kind.in_library}
    assert set(kinds) == {effect.id for effect in EFFECTS}
    for effect in EFFECTS:
        ours = {quantity.name: quantity for quantity in kinds[effect.id].parameters}
        for parameter in effect.parameters:
            _, unit, low, high, vanishing, *_ = ours[parameter.name]
            assert (unit, vanishing) == (parameter.unit, parameter.vanishing)
            assert parameter.low <= low < high <= parameter.high
            assert ours.pop(parameter.name).default is None
        assert all(more.default is not None for more in ours.values())
    strange = [kind for kind in EFFECT_DEFINITIONS if not kind.in_library]
    assert len(strange) >= 8
    assert len(DEFINITION_BY_ID) == len(EFFECT_DEFINITIONS)


@pytest.mark.parametrize(
    ("text", "key", "names"),
    [
        (effect("bouc_wenn", force=1.0), "effects.0.id", ("'bouc_wenn'", "'bouc_wen'")),
        (effect("bouc_wen", force=1.0), PARAMETERS, ("'yield_displacement'", "1e-05")),
        (effect("cubic_stiffness", k33=1.0), PARAMETERS, ("'k33'", "'k3'")),
        (effect("cubic_stiffness", k3=-1e9), PARAMETERS, ("k3 = -1e+09", "-3e+07 to 1e+10 N/m3")),
        (effect("cubic_stiffness", "mass_acc_m_s2", k3=1.0), PARAMETERS, ("channel",)),
        (effect("sensor_gain", gain=1.1), PARAMETERS, ("channel",)),
        (effect("table_tilt", tilt=0.1) * 2, "effects", ("table_tilt",)),
        (
            '[[effects]]\nid = "coulomb_friction"\nform = "x"\nparameters = {}',
            "effects.0.form",
            ("'x'", "tanh"),
        ),
        ("[base]\nmass = 3.0", "base.mass", ("'mass_kg'",)),
        ("[base]\ngap_left_m = nan", "base.gap_left_m", ("nan",)),
    ],
)
def test_truth_that_makes_no_sense_is_refused(text: str, key: str, names: tuple[str, ...]) -> None:
    with pytest.raises(InputError) as error:
        parse_toml(text, GroundTruth, "truth.toml")
    (fault,) = error.value.faults
    assert fault.key == key
    assert all(name in f"{fault.problem} {fault.allowed} {fault.remedy}" for name in names)


def test_seal_is_checked_and_the_file_is_named(tmp_path: Path) -> None:
    keys = seal_truth(tmp_path, PHYSICS)
    raw = CARD.model_dump()
    raw["simulated"].update(keys)
    card = RigConfig.model_validate(raw)
    SimulatedBackend(card, SPECIMEN, RATE_HZ, ManualClock())
    assert (
        parse_ground_truth(PHYSICS.encode(), keys["truth_sha256"].upper(), "x").base.mass_kg is None
    )
    Path(keys["truth"]).write_text(PHYSICS + "\n")
    digest = hashlib.sha256((PHYSICS + "\n").encode()).hexdigest()
    with pytest.raises(InputError, match=digest) as error:
        SimulatedBackend(card, SPECIMEN, RATE_HZ, ManualClock())
    assert error.value.where.endswith("truth.toml")
    assert (error.value.key, error.value.value) == ("truth_sha256", keys["truth_sha256"])
    Path(keys["truth"]).unlink()
    with raises_input_error(key="simulated.truth", value=keys["truth"]):
        SimulatedBackend(card, SPECIMEN, RATE_HZ, ManualClock())


@pytest.mark.parametrize("key", ["truth", "truth_sha256"])
def test_truth_without_its_hash_is_refused(key: str) -> None:
    value = {"truth": "a.toml", "truth_sha256": "0" * 64}[key]
    with pytest.raises(InputError) as error:
        parse_toml(CARD_TOML + f'{key} = "{value}"\n', RigConfig, "card")
    (fault,) = error.value.faults
    assert fault.key == "simulated.truth_sha256"


def test_key_hidden_of_the_rig_file_hides_without_a_seal(tmp_path: Path) -> None:
    text = PHYSICS.replace("[base]", "[simulated.hidden.base]")
    text = text.replace("[[effects]]", "[[simulated.hidden.effects]]")
    rig = parse_toml(CARD_TOML + text, RigConfig, "card")
    hidden = SimulatedBackend(rig, SPECIMEN, RATE_HZ, ManualClock())
    hidden.open()
    volts = acquire_run(hidden, [1000])
    assert (volts == acquire_run(machine(tmp_path, PHYSICS), [1000])).all()
    assert (volts != acquire_run(machine(tmp_path, None), [1000])).any()
    sealed = f'truth = "a.toml"\ntruth_sha256 = "{"0" * 64}"\n'
    with pytest.raises(InputError) as error:
        parse_toml(CARD_TOML + sealed + text, RigConfig, "card")
    assert [fault.key for fault in error.value.faults] == ["simulated.truth_sha256"]


def test_truth_with_nothing_in_it_is_no_truth(tmp_path: Path) -> None:
    plain, empty = machine(tmp_path, None, noise_rms=0.0), machine(tmp_path, "", noise_rms=0.0)
    step = [[2 * abs(s.range * s.volts_per_unit) / 2**s.bits] for s in CARD.sensors]
    lost = np.abs(acquire_run(empty, [3000]) - acquire_run(plain, [3000]))
    assert (lost <= 1.01 * np.array(step)).all()  # rounding may tip a converter by one step


def readings(folder: Path, text: str | None) -> tuple[Float2D, Float2D]:
    """(tared SI readings of a run, true signals) without noise."""
    backend = machine(folder, text, noise_rms=0.0)
    signals: list[Float2D] = []
    backend.observer = lambda first, command, out: signals.append(out.copy())
    tare = compute_tare(backend.tare(100), CARD.sensors)
    return volts_to_si(acquire_run(backend, [3000]), CARD.sensors, tare), np.concatenate(
        signals, axis=1
    )


@pytest.mark.parametrize("lag", [0.0, 0.3e-3, 0.5e-3, 1.2e-3, 4.56e-3])
def test_sensor_lag_delays_the_signal(tmp_path: Path, lag: float) -> None:
    nominal, _ = readings(tmp_path, None)
    late, signals = readings(tmp_path, effect("sensor_lag", "mass_disp_m", lag=lag))
    row = CARD.channels.index("mass_disp_m")
    t = np.arange(3000) / RATE_HZ
    expected = np.interp(t - lag, t, signals[2])
    assert signals.shape[0] == 6
    # Straight lines between samples are off by up to a h^2 / 8 where the mass turns.
    np.testing.assert_allclose(late[row, 20:], expected[20:], rtol=0, atol=1e-6)
    if lag == 0.0:
        np.testing.assert_allclose(late[row], nominal[row], rtol=0, atol=2e-8)
    np.testing.assert_array_equal(np.delete(late, row, 0), np.delete(nominal, row, 0))


def test_between_samples_a_late_sensor_is_a_cubic(tmp_path: Path) -> None:
    def errors(rate: float) -> Float1D:
        text = effect("sensor_lag", "mass_acc_m_s2", lag=1.37e-3)
        misread = SensorDistortion(parse_toml(text, GroundTruth, "x"), ("mass_acc_m_s2",), rate)
        t = np.arange(round(rate)) / rate
        delayed = misread.apply(np.sin(20 * t)[None, :])[0]
        return np.abs(delayed - np.sin(20 * (t - 1.37e-3)))[50:]

    assert errors(1000.0).max() < 1e-6
    assert errors(2000.0).max() < errors(1000.0).max() / 10


def test_gain_and_offset_come_after_the_tare(tmp_path: Path) -> None:
    nominal, _ = readings(tmp_path, None)
    text = effect("sensor_offset", "mass_acc_m_s2", offset=0.25)
    text += effect("sensor_gain", "mass_acc_m_s2", gain=1.2)
    values, _ = readings(tmp_path, text)
    np.testing.assert_allclose(values[ACC], 1.2 * nominal[ACC] + 0.25, rtol=0, atol=2e-5)
    np.testing.assert_array_equal(np.delete(values, ACC, 0), np.delete(nominal, ACC, 0))


def test_sensor_that_the_rig_lacks_cannot_err(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="sensor_gain") as error:
        machine(tmp_path, effect("sensor_gain", "rel_disp_m", gain=1.1))
    assert (error.value.key, error.value.value) == ("channel", "rel_disp_m")


def test_damper_force_is_that_of_the_damper_alone(tmp_path: Path) -> None:
    raw = CARD.model_dump()
    raw["sensors"] = [dict(sensor) for sensor in raw["sensors"]]
    raw["sensors"][7].update(channel="damper_force_n", noise_rms=0.0, offset=0.0)
    raw["simulated"].update(
        seal_truth(tmp_path, effect("table_tilt", tilt=1.0) + effect("cubic_stiffness", k3=1e8))
    )
    card = RigConfig.model_validate(raw)
    backend = SimulatedBackend(card, SPECIMEN, RATE_HZ, ManualClock())
    backend.open()
    signals: list[Float2D] = []
    backend.observer = lambda first, command, out: signals.append(out.copy())
    force = volts_to_si(acquire_run(backend, [3000]), card.sensors, {})[7]
    y, _, x, _, _, _ = signals[0]
    u = x - y
    v = np.gradient(u, 1 / RATE_HZ)
    expected = 36e3 * u + 1100.0 * v + 1e8 * u**3
    assert np.abs(force).max() > 100.0
    assert np.median(np.abs(force - expected)) < 1.0


def spell_number(number: float) -> Iterator[bytes]:
    """How a number could stand in a recording."""
    yield from (form.encode() for form in {str(number), repr(number), f"{number:g}"})
    yield from (struct.pack(order, number) for order in ("<d", ">d"))


def test_recording_holds_the_hash_and_nothing_else_of_the_truth(tmp_path: Path) -> None:
    keys = seal_truth(tmp_path, PHYSICS)
    card = tmp_path / "card.toml"
    card.write_text(CARD_TOML + "".join(f'{key} = "{value}"\n' for key, value in keys.items()))
    profile = tmp_path / "quick.toml"
    profile.write_text(
        format_test(
            3.2, 3.4, 0.2, tables=AT_1_KHZ | UNCHECKED, rig=card, cycles=3, measured_cycles=1
        )
    )
    bundle = read_run_config(profile)
    play_unpaced(bundle, "quick", tmp_path / "run.mcap", lambda: None, lambda item: None)
    Path(keys["truth"]).unlink()
    recording = read_recording(tmp_path / "run.mcap")
    assert recording.stop is not None
    again = read_recorded_config(recording)  # no truth needed to read, to parse or to replay it
    table = again.rig.get_section(SimulatedTableConfig)
    assert table is not None
    assert table.truth_sha256 == keys["truth_sha256"]
    log = tmp_path / "run.mcap"
    held = b"".join([log.read_bytes(), *(message.payload for message in recover_log(log).messages)])
    truth = parse_toml(PHYSICS, GroundTruth, "truth")
    (rubber, drift), stiffness = truth.effects, truth.base.damper_stiffness_n_m
    assert stiffness is not None
    sizes = rubber.parameters["force"], rubber.parameters["yield_displacement"]
    for number in (stiffness, *sizes, drift.parameters["rate"]):
        assert not any(form in held for form in spell_number(number)), number
    assert any(form in held for form in spell_number(36000.0))
    assert keys["truth_sha256"].encode() in held
