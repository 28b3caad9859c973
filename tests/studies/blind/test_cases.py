"""The blind cases: drawn from their numbers alone, of the size asked for, and silent about it."""

import hashlib
import json
import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest

from table_io.block import Label
from table_io.config.base import parse_toml
from table_io.errors import InputError
from table_io.sim.ground_truth import EFFECT_DEFINITIONS, GroundTruth
from tests.studies.blind import cases, plant, sizes
from tests.studies.blind.cases import CELLS, NUMBERS_PER_CELL, Case, draw_case, list_case_numbers
from tests.studies.blind.discovery_study import evaluate_case
from tests.studies.blind.plant import CasePaths, generate_case
from tests.studies.blind.rig import (
    PROFILE,
    StudySignals,
    compute_noise_rms,
    make_rig_toml,
    simulate_signals,
)
from tests.studies.blind.sizes import (
    BaselineResidual,
    apply_sensor_effect,
    evaluate_residual,
    find_share,
    max_share,
    scale_parameters,
)
from twin.recording.reader import read_recording as read_log
from twin.results.recordings import read_recorded_config


def case_in(cell: str, place: int = 0) -> Case:
    names = [cell.name for cell in CELLS]
    return draw_case(NUMBERS_PER_CELL * names.index(cell) + place)


@pytest.fixture(scope="module")
def generated_case(tmp_path_factory: pytest.TempPathFactory) -> tuple[Case, CasePaths]:
    case = case_in("single/coulomb_friction/3/1%")
    return case, generate_case(case, tmp_path_factory.mktemp("study"))


def test_a_case_is_drawn_from_its_number_alone() -> None:
    numbers = list_case_numbers(2)
    alone = draw_case(numbers[100])
    for number in numbers[:100]:
        draw_case(number)
    assert draw_case(numbers[100]) == alone
    assert draw_case(numbers[100]).base == alone.base
    every = [draw_case(number) for number in numbers]
    assert len({case.label for case in every}) == len({case.salt for case in every}) == len(every)
    assert {len(case.label) for case in every} == {10}


def test_every_effect_size_noise_and_kind_has_its_cells() -> None:
    ideal = [cell for cell in CELLS if cell.laboratory == "none"]
    counts = {kind: sum(c.kind == kind for c in ideal) for kind in ("none", "single", "unknown")}
    assert counts == {"none": 3, "single": 19 * 9, "unknown": 28 * 9}
    assert len({cell.name for cell in CELLS}) == len(CELLS)
    assert len(list_case_numbers(10, ["none/*"])) == 150
    assert len(list_case_numbers(10, ["single/*/3/1%"])) == 190
    first = list_case_numbers(3, ["single/*/3/1%"])[:19]
    assert [number % NUMBERS_PER_CELL for number in first] == [0] * 19, (
        "one of each cell comes first"
    )
    with pytest.raises(InputError) as error:
        list_case_numbers(1, ["singles/*"])
    assert (error.value.key, error.value.value) == ("--cells", "singles/*")


def test_the_base_is_scattered_within_five_per_cent_in_clean_cases_too() -> None:
    for cell in ("none/1%", "single/cubic_stiffness/3/1%"):
        base = np.array([list(case_in(cell, k).base.values()) for k in range(200)])
        assert np.abs(base - 1.0).max() <= 0.05
        assert (base.std(axis=0) > 0.024).all()


def test_a_pair_is_two_effects_of_the_library() -> None:
    drawn = [case_in("pair/3/1%", k).planted for k in range(50)]
    names = [tuple(effect.effect.name for effect in pair) for pair in drawn]
    assert all(len(set(pair)) == 2 for pair in names)
    assert len(set(names)) > 30


@pytest.mark.parametrize(
    "cell", ["single/mass_error/3/1%", "sensor/sensor_gain.mass_acc_m_s2/1.5/0.2%"]
)
def test_sizes_land_where_they_were_asked(cell: str) -> None:
    """The residual of a refitted baseline over the noise, from signals with that noise on."""
    case = case_in(cell)
    shares, left = plant.find_shares(case)
    assert left.size == pytest.approx(case.cell.size, rel=0.1)
    assert noisy_size(case, shares[0]) == pytest.approx(case.cell.size, rel=0.25)


def test_generated_case_has_its_planned_size(generated_case: tuple[Case, CasePaths]) -> None:
    case, places = generated_case
    about = json.loads(places.about.read_text())
    assert about["reached"] == pytest.approx(3.0, rel=0.1)
    fc = about["effects"][0]["parameters"]["fc"]
    share = fc / case.planted[0].effect.amplitudes[0].typical
    assert noisy_size(case, share) == pytest.approx(3.0, rel=0.25)


def test_noise_alone_has_size_one() -> None:
    signals = simulate_signals(make_rig_toml(0.0))
    for noise in cases.NOISE_LEVELS:
        assert noisy(signals, signals, compute_noise_rms(noise)).rms == pytest.approx(1.0, abs=0.05)


def noisy_size(case: Case, share: float) -> float:
    (planted,) = case.planted
    signals = plant.simulate_truth(case, case.planted, [share])
    return noisy(
        apply_sensor_effect(planted, share, signals), signals, compute_noise_rms(case.cell.noise)
    ).rms


def noisy(signals: StudySignals, truly: StudySignals, rms: Mapping[str, float]) -> BaselineResidual:
    """What the baseline leaves of noisy readings over their noise; the noise is white to 225 Hz."""
    draw, size = np.random.default_rng(1), signals.step.size
    inside = np.fft.rfftfreq(size, 1e-3) <= sizes.BANDWIDTH_HZ
    noise = {
        name: np.fft.irfft(np.fft.rfft(draw.normal(0.0, s, size)) * inside, size)
        for name, s in rms.items()
    }
    right = signals.right + noise["force_r1_n"] + noise["force_r2_n"]
    left = signals.left - noise["force_l1_n"] - noise["force_l2_n"]
    channels = {name: values + noise[name] for name, values in signals.channels.items()}
    return evaluate_residual(
        StudySignals(channels, right, left, signals.step, signals.label), truly, rms
    )


def test_an_effect_that_cannot_reach_its_size_says_what_it_reaches() -> None:
    (planted,) = case_in("single/gap_offset/10/1%").planted
    asked: list[float] = []

    def saturates(share: float) -> BaselineResidual:
        asked.append(share)
        return BaselineResidual(min(share, 2.0), {1.0: 1.0}, {"flight": 1.0})

    share, left = find_share(planted, 10.0, saturates)
    assert left.size == pytest.approx(np.hypot(1.0, 2.0))
    assert max(asked) <= max_share(planted)
    bounds = planted.effect.amplitudes[0]
    assert bounds.low <= scale_parameters(planted, share)["offset"] <= bounds.high


def test_what_does_not_have_its_size_is_not_played(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    case = case_in("single/gap_offset/10/1%")
    little = BaselineResidual(2.0, {1.0: 1.0}, {"flight": 1.0})
    monkeypatch.setattr(plant, "find_shares", lambda case: ([1.0], little))
    places = generate_case(case, tmp_path)
    about = json.loads(places.about.read_text())
    assert about["ended"] == "not played: the effect reaches size 2.24"
    assert not about["sized"]
    assert not places.log.exists()
    row = evaluate_case(tmp_path, case.number, lambda shown: pytest.fail("nothing to judge"))
    assert (row["sized"], row["reached"]) == (False, pytest.approx(5**0.5))


def test_a_residual_that_falls_again_is_sought_before_it_falls() -> None:
    (planted,) = case_in("single/coulomb_friction/10/1%").planted
    share, left = find_share(
        planted,
        3.0,
        lambda s: BaselineResidual(0.2 * s**2 if s < 4 else 0.1, {1.0: 1.0}, {"flight": 1.0}),
    )
    assert left.size == pytest.approx(3.0, rel=0.05)
    assert share == pytest.approx((8.0**0.5 / 0.2) ** 0.5, rel=0.05)


def test_the_test_shows_flight_both_branches_and_irregular_impacts() -> None:
    signals = simulate_signals(make_rig_toml(0.0))
    assert 55 < signals.moving.sum() / 1000 < 65
    steps = PROFILE.sweep.steps
    share = {
        (step.direction, step.frequency_hz): (signals.right[signals.step == step.index] > 0).mean()
        for step in steps
    }
    assert share["forward", 3.6] > 0.25
    assert share["backward", 3.6] == 0.0
    peaks = []
    slow = signals.step == next(step.index for step in steps if step.frequency_hz == 1.2)
    right = signals.right[slow]
    onsets = np.flatnonzero((right[1:] > 0) & (right[:-1] <= 0))
    peaks = [right[a:b].max() for a, b in zip(onsets, [*onsets[1:], right.size], strict=True)]
    assert len(peaks) > 5
    assert np.std(peaks) > 0.2 * np.mean(peaks), "impacts differ from one to the next"


def test_noise_is_the_same_whatever_is_hidden() -> None:
    assert compute_noise_rms(0.01)["mass_acc_m_s2"] == pytest.approx(0.009, rel=0.01)
    texts = {
        make_rig_toml(case_in(cell).cell.noise)
        for cell in ("none/1%", "single/bouc_wen/10/1%", "single/appendage/1.5/1%")
    }
    assert len(texts) == 1


def test_the_recording_is_whole_and_has_the_noise_of_its_cell(
    generated_case: tuple[Case, CasePaths],
) -> None:
    case, places = generated_case
    recording = read_log(places.log)
    assert recording.stop is not None
    assert recording.stop.verdict == "complete"
    whole = recording.contiguous_blocks("meas")[0]
    rest = whole.label == Label.REST
    first = np.flatnonzero(~rest)[0]
    for name, rms in compute_noise_rms(case.cell.noise).items():
        assert whole.channel(name)[:first].std() == pytest.approx(rms, rel=0.15), name
    assert read_recorded_config(recording).model.effects == ()


def test_nothing_that_is_shown_holds_the_truth(generated_case: tuple[Case, CasePaths]) -> None:
    case, places = generated_case
    text = (places.sealed_dir / "truth.toml").read_text()
    truth = parse_toml(text, GroundTruth, "truth")
    assert truth.effects[0].id == "coulomb_friction"
    numbers = [n for n in re.findall(r"= ([-\d.e]+)$", text, re.M) if len(n) > 4]
    assert len(numbers) >= 6
    words = ["coulomb", case.salt, case.cell.name]
    secrets = [*map(re.escape, words), *(rf"\b{word}\b" for word in (*numbers, case.number))]
    shown = list(places.case_dir.iterdir())
    assert {path.name for path in shown} == {"log.mcap", "profile.toml", "model.toml"}
    start = read_log(places.log).start
    texts = [*(path.read_bytes() for path in shown), *(
        text.encode() for text in (start.rig_toml, start.profile_toml, start.model_toml, start.run)
    )]  # fmt: skip
    for secret in secrets:
        where = [k for k, held in enumerate(texts) if re.search(secret.encode(), held)]
        assert not where, secret
    assert f'truth_sha256 = "{hashlib.sha256(text.encode()).hexdigest()}"' in start.rig_toml


@pytest.mark.slow  # 5 s
def test_a_case_that_was_cut_off_is_made_anew_and_the_same(
    generated_case: tuple[Case, CasePaths],
) -> None:
    case, places = generated_case
    before, samples = places.about.read_text(), read_log(places.log).contiguous_blocks("meas")[0]
    sealed = (places.sealed_dir / "truth.toml").read_text()
    assert generate_case(case, places.root) == places
    places.about.unlink()
    places.log.write_bytes(places.log.read_bytes()[:1000])
    generate_case(draw_case(case.number), places.root)
    assert json.loads(places.about.read_text()) == json.loads(before)
    assert (places.sealed_dir / "truth.toml").read_text() == sealed
    assert read_log(places.log).contiguous_blocks("meas")[0].is_identical(samples)


def test_every_kind_that_can_be_hidden_has_what_the_generator_needs() -> None:
    for cell in CELLS:
        for hidden in cell.effects:
            assert hidden.amplitudes, hidden.name
    for (effect, name), (low, high) in cases.SHAPE_RANGES.items():
        kinds = [definitions for definitions in EFFECT_DEFINITIONS if definitions.id == effect]
        parameters = [q for kind in kinds for q in kind.parameters if q.name == name]
        assert parameters, (effect, name)
        assert all(q.low <= low < high <= q.high for q in parameters), (effect, name)


def test_the_root_may_be_anywhere(tmp_path: Path) -> None:
    places = CasePaths(tmp_path, "ab")
    assert places.case_dir.is_relative_to(tmp_path / "cases")
    assert places.sealed_dir.is_relative_to(tmp_path / "sealed")
