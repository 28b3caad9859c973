"""Imperfections of the laboratory: definitions, ground-truth entries and random laboratories."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from table_io.channels import CHANNEL_BY_NAME
from table_io.config.base import parse_toml
from table_io.errors import InputError
from table_io.sim.ground_truth import GroundTruth
from table_io.sim.imperfections import (
    IMPERFECTION_BY_ID,
    IMPERFECTION_DEFINITIONS,
    IMPERFECTION_IDS,
    Imperfection,
    ImperfectionDefinition,
    resolve_sides,
)
from tests.builders.laboratories import LABORATORY_CHANNELS, draw_laboratory
from tests.input_errors import raises_input_error

DOC = Path(__file__).resolve().parents[3] / "table_io" / "sim" / "IMPERFECTIONS.md"


def entry(name: str, where: str = "", **parameters: float | str) -> str:
    """One entry of [[imperfections]]."""
    numbers = ", ".join(f"{key} = {value}" for key, value in parameters.items())
    return f'[[imperfections]]\nid = "{name}"\n{where}\nparameters = {{ {numbers} }}\n'


@pytest.mark.parametrize("definition", IMPERFECTION_DEFINITIONS, ids=lambda d: f"{d.id}-{d.form}")
def test_each_definition_states_sizes_and_a_source(definition: ImperfectionDefinition) -> None:
    assert definition.meaning
    assert definition.source
    growing = []
    for parameter in definition.parameters:
        default, bad = parameter.default, parameter.bad
        assert default is not None
        assert bad is not None
        for value in (default, parameter.typical, bad):
            assert parameter.low <= value <= parameter.high
        if parameter.vanishing is None:
            continue
        assert default == parameter.vanishing
        if parameter.vanishing == np.inf:
            growing.append(bad < parameter.typical < np.inf)
        elif parameter.typical != parameter.vanishing:
            growing.append(abs(bad - default) > abs(parameter.typical - default))
    assert growing
    assert all(growing)
    row = f"| `{definition.id}` |"
    assert row in DOC.read_text()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (entry("humm", rms=1.0), r"imperfection 'humm' is unknown; did you mean 'hum'"),
        (entry("hum", rmss=1.0), r"hum: no parameter 'rmss'; did you mean 'rms'"),
        (entry("hum", rms=-1.0), r"rms = -1; allowed: 0 to 10000 unit of the channel"),
        (entry("hum", rms="nan"), r"rms = nan; allowed: 0 to"),
        (entry("hum", frequency=50.0), r"states no size; add rms or rms_over_noise"),
        (entry("anti_alias_filter", order=4.5, corner_hz=9.0), r"order = 4.5; .* a whole number"),
        (entry("anti_alias_filter", corner_hz=0.1), r"corner_hz = 0.1; allowed: 1 to inf Hz"),
        (entry("anti_alias_filter", 'form = "b"', corner_hz=9.0), r"no form 'b'; .*butterworth"),
        (entry("time_base", 'channel = "table_disp_m"', deviation=1.0), r"has no channel; leave"),
        (entry("hum", 'side = "left"', rms=1.0), r"has no side; leave it out"),
        (entry("plate_mass", 'side = "top"', mass=1.0), r"side = 'top'"),
        (entry("hum", rms=1.0) * 2, r"hum more than once"),
        (entry("plate_mass", 'side = "left"', mass=1.0) * 2, r"plate_mass left more than once"),
        (entry("hum", "x = 1", rms=1.0), r"imperfections.0.x: unknown key"),
    ],
)
def test_imperfection_that_makes_no_sense_is_refused(text: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        parse_toml(text, GroundTruth, "truth.toml")


def test_defaults_are_completed_and_infinity_is_a_number() -> None:
    text = entry("load_sharing", 'side = "left"', share_per_m=2.0)
    text += entry("anti_alias_filter", 'form = "bessel"', corner_hz="inf")
    sharing, alias = parse_toml(text, GroundTruth, "x").imperfections
    assert sharing.parameters == {"share": 0.5, "share_per_m": 2.0}
    assert (alias.form, alias.parameters["order"]) == ("bessel", 4)
    assert alias.is_absent
    assert not sharing.is_absent


def test_entry_of_one_side_wins() -> None:
    text = entry("plate_mass", 'side = "left"', mass=5.0) + entry("plate_mass", mass=1.0)
    plates = resolve_sides(parse_toml(text, GroundTruth, "x").imperfections, "plate_mass")
    assert plates == {"right": {"mass": 1.0}, "left": {"mass": 5.0}}


def sizes(laboratory: list[Imperfection], name: str, parameter: str) -> list[float]:
    return [e.parameters[parameter] for e in laboratory if e.id == name]


def test_drawn_laboratory_has_everything_everywhere_and_is_a_ground_truth() -> None:
    laboratory = draw_laboratory("typical", np.random.default_rng(3))
    assert GroundTruth(imperfections=tuple(laboratory)).imperfections == tuple(laboratory)
    assert {e.id for e in laboratory} == set(IMPERFECTION_IDS)
    assert draw_laboratory("typical", np.random.default_rng(3)) == laboratory
    assert draw_laboratory("typical", np.random.default_rng(4)) != laboratory
    for name in IMPERFECTION_IDS:
        entries = [e for e in laboratory if e.id == name]
        definition = entries[0].definition
        assert not any(e.is_absent for e in entries)
        if definition.has_side:
            assert [e.side for e in entries] == ["right", "left"]
        elif definition.quantities:
            channels = [e.channel for e in entries]
            assert len(set(channels)) == len(channels) >= 2
            assert set(channels) <= set(LABORATORY_CHANNELS)
            quantities = {CHANNEL_BY_NAME[str(c)].quantity for c in channels}
            assert definition.quantities == ("*",) or quantities <= set(definition.quantities)
        else:
            assert len(entries) == 1
    phases = sizes(laboratory, "hum", "phase")
    assert len(set(phases)) == len(LABORATORY_CHANNELS) == 8
    equal = sizes(laboratory, "anti_alias_filter", "corner_hz")
    unequal = sizes(
        draw_laboratory("bad", np.random.default_rng(3)), "anti_alias_filter", "corner_hz"
    )
    assert 0 < np.std(np.log(equal)) < 0.05 < np.std(np.log(unequal))


@pytest.mark.parametrize(
    ("name", "parameter", "is_signed", "distance"),
    [
        ("load_sharing", "share", True, lambda x: abs(x - 0.5)),
        ("mass_reading", "ratio", True, lambda x: abs(x - 1.0)),
        ("hum", "rms_over_noise", False, lambda x: x),
        ("anti_alias_filter", "corner_hz", False, lambda x: 1 / x),
        ("cross_axis", "share", True, abs),
    ],
)
def test_drawn_sizes_scatter_about_the_stated_ones(
    name: str, parameter: str, is_signed: bool, distance: Callable[[float], float]
) -> None:
    generator = np.random.default_rng(0)
    definition = next(d for d in IMPERFECTION_DEFINITIONS if d.id == name)
    stated = next(p for p in definition.parameters if p.name == parameter)
    assert stated.bad is not None
    for level, size in (("typical", stated.typical), ("bad", stated.bad)):
        drawn = np.array(
            [
                value
                for _ in range(200)
                for value in sizes(draw_laboratory(level, generator, name), name, parameter)  # type: ignore[arg-type]
            ]
        )
        ratios = np.array([distance(value) for value in drawn.tolist()]) / distance(size)
        assert np.median(ratios) == pytest.approx(1.0, abs=0.06)
        assert 0.15 < np.log(ratios).std() < 0.35
        assert len(set(drawn.tolist())) == drawn.size
        if is_signed:
            assert 0.35 < np.mean(drawn > (stated.vanishing or 0.0)) < 0.65


def test_only_one_and_only_known_ones_are_drawn() -> None:
    generator = np.random.default_rng(0)
    drawn = draw_laboratory("bad", generator, "quantisation", ("mass_disp_m", "force_r1_n"))
    assert [e.channel for e in drawn] == ["mass_disp_m", "force_r1_n"]
    bits = sizes(draw_laboratory("bad", generator, "quantisation"), "quantisation", "bits")
    assert set(bits) == {11.0, 12.0, 13.0}
    forms = {draw_laboratory("bad", generator, "anti_alias_filter")[0].form for _ in range(20)}
    assert forms == {form for name, form in IMPERFECTION_BY_ID if name == "anti_alias_filter"}
    with raises_input_error(key="only", value="hun"):
        draw_laboratory("bad", generator, "hun")
