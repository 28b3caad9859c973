"""Which column is which, in which unit, and when its samples were taken."""

from pathlib import Path

import numpy as np
import pytest

from table_io.block import Float1D
from table_io.errors import InputError
from table_io.formats.table import ForeignTable, make_column
from table_io.formats.timing import find_holes
from tests.input_errors import raises_input_error
from twin.exchange.columns import ImportedSamples, read_samples
from twin.exchange.import_table import ImportOptions

TIME = np.arange(400) / 200.0


def import_columns(folder: Path, card: str | None = None, **columns: Float1D) -> ImportedSamples:
    """The samples of a table of these columns with a map of this text."""
    path = folder / "map.toml"
    if card is not None:
        path.write_text(card)
    file = folder / "table.csv"
    file.touch()
    held = {name: make_column(values) for name, values in columns.items()}
    table = ForeignTable(file, "a table", held, first_row=2)
    options = ImportOptions(columns=path if card is not None else None)
    return read_samples(table, options.read_map())


def require_refused(
    folder: Path, words: list[str], card: str | None = None, **columns: Float1D
) -> None:
    with pytest.raises(InputError) as caught:
        import_columns(folder, card, **columns)
    for word in words:
        assert word in str(caught.value)


def wave(hz: float = 2.0) -> Float1D:
    return np.sin(2 * np.pi * hz * TIME)


def test_a_map_converts_as_it_says_and_leaves_the_rest_out(tmp_path: Path) -> None:
    card = """
    [columns]
    time_s = { column = "t", unit = "ms" }
    rel_disp_m = { column = "V2", unit = "mm", gain = -2.0, offset = 0.5 }
    table_acc_m_s2 = { column = "V1", unit = "g" }
    """
    samples = import_columns(tmp_path, card, t=1e3 * TIME, V1=wave(), V2=wave(3), V3=wave(4))
    assert samples.rate_hz == 200.0
    assert list(samples.channels) == ["table_acc_m_s2", "rel_disp_m"]
    np.testing.assert_allclose(samples.channels["table_acc_m_s2"], 9.80665 * wave())
    np.testing.assert_allclose(samples.channels["rel_disp_m"], -2e-3 * wave(3) + 0.5)
    assert "left out: V3" in samples.notes


def test_a_rate_stands_in_for_time(tmp_path: Path) -> None:
    samples = import_columns(tmp_path, "rate_hz = 610.35", rel_disp_m=wave())
    assert samples.rate_hz == 610.35
    assert samples.index.tolist() == list(range(400))


@pytest.mark.parametrize(
    ("card", "words"),
    [
        ("rate_hz = 0", ["map.toml", "rate_hz = 0"]),
        ("rate = 5.0", ["rate: unknown key", "'rate_hz'"]),
        ("[columns]\nrel_dsp_m = {column = 'b'}", ["rel_dsp_m", "did you mean 'rel_disp_m'?"]),
        ("[columns]\nrel_disp_m = {column = 'b', unit = 'N'}", ["unit 'N'", "m, mm, um"]),
        ("[columns]\nrel_disp_m = {column = 'b', gain = 0.0}", ["gain is 0"]),
        ("[columns]\nrel_disp_m = {colum = 'b'}", ["did you mean 'column'?"]),
        ("[columns]\nrel_disp_m = {column = 'bb'}", ["no column 'bb'", "did you mean 'b'?"]),
        (
            "rate_hz = 5.0\n[columns]\ntime_s = {column = 't'}\nrel_disp_m = {column = 'b'}",
            ["rate_hz = 5.0", "200 Hz"],
        ),
        ("[columns]\nrel_disp_m = {column = 'b'}", ["no column time_s", "rate_hz"]),
        ("rate_hz = 5.0", ["no channel in it"]),
        (
            "rate_hz = 5.0\n[columns]\nrel_disp_m = {column = 'b', gain = 1e308, offset = 1e308}",
            ["rel_disp_m", "'b'", "infinite"],
        ),
    ],
)
def test_invalid_column_map_is_refused(tmp_path: Path, card: str, words: list[str]) -> None:
    require_refused(tmp_path, words, card, t=TIME, b=wave())


def test_an_unknown_column_without_a_map_is_refused_with_the_nearest_name(tmp_path: Path) -> None:
    words = ["'table_acc'", "did you mean 'table_acc_m_s2'?", "--columns"]
    require_refused(tmp_path, words, time_s=TIME, table_acc=wave())


@pytest.mark.parametrize(
    ("place", "value", "words"),
    [
        (7, TIME[6], ["row 9", "time must rise"]),
        (7, TIME[2], ["row 9", "time must rise"]),
        (7, np.nan, ["row 9", "empty"]),
    ],
)
def test_time_that_does_not_rise_names_its_row(
    tmp_path: Path, place: int, value: float, words: list[str]
) -> None:
    time = TIME.copy()
    time[place] = value
    require_refused(tmp_path, ["table.csv", "time_s", *words], time_s=time, rel_disp_m=wave())


def test_time_that_is_nowhere_uniform_is_refused(tmp_path: Path) -> None:
    for time in (TIME**1.5, np.sort(np.random.default_rng(0).uniform(0, 2, 400))):
        require_refused(tmp_path, ["resample"], time_s=time, rel_disp_m=wave())


@pytest.mark.parametrize("rate", [200.0, 610.35, 2000.0, 1e4 / 3])
def test_rounded_and_jittering_time_is_taken_as_uniform(tmp_path: Path, rate: float) -> None:
    jitter = np.random.default_rng(0).uniform(-0.2, 0.2, 5000)
    time = 3.0 + (np.arange(5000) + jitter) / rate
    samples = import_columns(tmp_path, time_s=np.round(time, 5), rel_disp_m=np.ones(5000))
    assert samples.index.tolist() == list(range(5000))
    assert samples.rate_hz == pytest.approx(rate, rel=2e-5)
    assert any("jitters" in text for text in samples.notes)
    assert any("begins at" in text for text in samples.notes)


def test_holes_keep_their_length(tmp_path: Path) -> None:
    keep = np.r_[0:100, 103:250, 390:400]
    samples = import_columns(tmp_path, time_s=np.round(TIME, 3)[keep], rel_disp_m=wave()[keep])
    assert samples.index.tolist() == keep.tolist()
    assert find_holes(samples.index) == [(100, 3), (250, 140)]


BOTH = """[columns]
table_disp_m = {{ column = "table_disp_m"{disp} }}
table_acc_m_s2 = {{ column = "table_acc_m_s2"{acc} }}
"""


@pytest.mark.parametrize("wrong", [1000.0, 9.80665, 1000.0 * 9.80665, 39.37])
def test_units_that_contradict_each_other_are_refused_unless_stated(
    tmp_path: Path, wrong: float
) -> None:
    x, a = 1e-3 * wave(), -1e-3 * (4 * np.pi) ** 2 * wave()
    fine = import_columns(tmp_path, time_s=TIME, table_disp_m=x, table_acc_m_s2=a)
    assert not [text for text in fine.notes if "warning" in text]
    odd = {"time_s": TIME, "table_disp_m": x, "table_acc_m_s2": a / wrong}
    with raises_input_error(where=tmp_path / "table.csv", key="table_disp_m", allowed="mm"):
        import_columns(tmp_path, None, **odd)
    with raises_input_error(key="table_disp_m", problem="table_acc_m_s2"):
        import_columns(tmp_path, BOTH.format(disp=', unit = "m"', acc=""), **odd)
    stated = import_columns(
        tmp_path, BOTH.format(disp=', unit = "m"', acc=', unit = "m/s2"'), **odd
    )
    assert [text for text in stated.notes if "warning:" in text and "table_disp_m" in text]
    np.testing.assert_array_equal(stated.channels["table_acc_m_s2"], a / wrong)


def test_a_displacement_of_35_m_is_refused_and_a_quiet_table_warned_of(tmp_path: Path) -> None:
    with raises_input_error(key="rel_disp_m", problem="70"):
        import_columns(tmp_path, time_s=TIME, rel_disp_m=35.0 * wave())
    quiet = import_columns(tmp_path, time_s=TIME, table_acc_m_s2=0.0141 * wave())
    assert [text for text in quiet.notes if "warning:" in text and "table_acc_m_s2" in text]


def test_units_of_laboratories(tmp_path: Path) -> None:
    card = """[columns]
    rel_disp_m = { column = "x", unit = "in" }
    damper_force_n = { column = "F", unit = "kip" }
    mass_disp_m = { column = "y", unit = "cm" }
    """
    samples = import_columns(tmp_path, card, time_s=TIME, x=wave(), y=wave(), F=wave())
    for name, factor in (
        ("rel_disp_m", 0.0254),
        ("damper_force_n", 4448.2216152605),
        ("mass_disp_m", 0.01),
    ):
        np.testing.assert_allclose(samples.channels[name], factor * wave(), rtol=1e-12)


def test_a_slice_is_taken_in_the_times_of_the_file(tmp_path: Path) -> None:
    card = "from_s = 10.5\nto_s = 11.0\n"
    samples = import_columns(tmp_path, card, time_s=10.0 + TIME, rel_disp_m=TIME)
    assert samples.channels["rel_disp_m"][[0, -1]] == pytest.approx([0.5, 1.0])
    assert samples.index.tolist() == list(range(101))
    by_rate = import_columns(tmp_path, "from_s = 0.5\nrate_hz = 200.0", rel_disp_m=TIME)
    assert by_rate.channels["rel_disp_m"][0] == pytest.approx(0.5)
    with raises_input_error(key="--from, --to", allowed="0 to"):
        import_columns(tmp_path, "from_s = 9.0", time_s=TIME, rel_disp_m=wave())


@pytest.mark.parametrize(("kind", "slope"), [("mean", 1.0), ("line", 0.0)])
def test_a_trend_is_removed(tmp_path: Path, kind: str, slope: float) -> None:
    values = 0.3 + 0.1 * TIME
    values[5] = np.nan
    samples = import_columns(tmp_path, f'detrend = "{kind}"', time_s=TIME, rel_disp_m=values)
    channel = samples.channels["rel_disp_m"]
    assert np.nanmean(channel) == pytest.approx(0.0, abs=1e-12)
    assert np.nanmax(channel) - np.nanmin(channel) == pytest.approx(
        slope * 0.1 * TIME[-1], abs=1e-9
    )


def test_accelerations_are_integrated_in_the_stated_band(tmp_path: Path) -> None:
    """Outside the band nothing is left, of the accelerations neither."""
    rng, hz = np.random.default_rng(0), 2.0
    time = np.arange(4000) / 200.0
    u = 3e-3 * np.sin(2 * np.pi * hz * time) * np.hanning(time.size)
    acc = np.gradient(np.gradient(u, time), time)
    table = 0.2 * np.sin(2 * np.pi * 5.0 * time) * np.hanning(time.size)
    drift = 0.05 * np.sin(2 * np.pi * 0.07 * time)
    samples = import_columns(
        tmp_path, "integrate_hz = [0.5, 20.0]", time_s=time,
        mass_acc_m_s2=acc + table + drift + 1e-3 * rng.normal(size=time.size), table_acc_m_s2=table,
    )  # fmt: skip
    error = samples.channels["rel_disp_m"] - u
    assert error.std() < 0.06 * u.std()
    left = samples.channels["mass_acc_m_s2"] - acc - table
    assert left.std() < 0.05 * drift.std()
    assert any("0.5 to 20 Hz" in note for note in samples.notes)


@pytest.mark.parametrize(
    ("band", "allowed"),
    [("[0.5, 200.0]", "100 Hz"), ("[0.1, 20.0]", "1 to"), ("[9.0, 2.0]", "LOW")],
)
def test_invalid_integration_band_is_refused(tmp_path: Path, band: str, allowed: str) -> None:
    with raises_input_error(allowed=allowed):
        import_columns(tmp_path, f"integrate_hz = {band}", time_s=TIME, mass_acc_m_s2=wave())


def test_missing_and_lost_columns_are_noted(tmp_path: Path) -> None:
    samples = import_columns(
        tmp_path, time_s=TIME, rel_disp_m=wave(), force_r1_n=np.full(400, np.nan)
    )
    assert "force_r1_n: all samples lost" in samples.notes
    assert any(text.startswith("not in the file: drive_disp_m") for text in samples.notes)
