"""A law at the values of a model: refused where a test would leave it, named where it fails."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from table_io.block import Block, join_blocks
from table_io.errors import InputError
from table_io.records import Event
from tests.builders.profiles import NO_LOOP_CHECK, format_test
from twin.model.config import load_model_config
from twin.model.model import Model
from twin.model.prepare import prepare_solver
from twin.recording.reader import read_recording
from twin.results.summary import summarise
from twin.setup.run_config import read_model, read_run_config
from twin.setup.unpaced import play_unpaced, simulate_ideal
from twin.transport.codec import Item

LAW = """
id = "own"
force = "{force}"
[parameters]
k = {{ unit = "N/m", low = -1e15, high = 1e15, vanishing = 0.0, typical = 1e3 }}
{more}
[range]
u = [-0.001, 0.001]
v = [-0.01, 0.01]
"""
LOG = "k * u * log(1 + u * q)"
Q = 'q = { unit = "1/m", low = 0.0, high = 1e4, typical = 480.0 }'


def write_model(folder: Path, force: str, values: str) -> Path:
    """Write a model with an own law, and the law next to it."""
    (folder / "own.toml").write_text(LAW.format(force=force, more=Q if "q" in values else ""))
    path = folder / "model.toml"
    entry = f"\n[[effects]]\nfile = 'own.toml'\nparameters = {{ {values} }}\n"
    path.write_text(read_model("snm")[1] + entry)
    return path


def write_profile(folder: Path, model: Path | str, block: int = 50) -> Path:
    path = folder / "test.toml"
    path.write_text(
        format_test(
            2.8,
            3.0,
            0.2,
            model=model,
            acceleration_g=0.05,
            tables=NO_LOOP_CHECK | {"acquisition": {"rate_hz": 1000.0, "block_samples": block}},
        )
    )
    return path


def test_law_that_is_not_finite_in_the_foreseen_motion_is_refused(tmp_path: Path) -> None:
    model = write_model(tmp_path, LOG, "k = 1e3, q = 480.0")
    with pytest.raises(InputError) as caught:
        read_run_config(write_profile(tmp_path, model))
    text = str(caught.value)
    assert "effect 'own'" in text
    assert "not finite at displacement -0.002" in text  # 1 / q
    assert "this test foresees displacement up to 0.0" in text


def test_law_that_is_finite_in_the_foreseen_motion_is_used(tmp_path: Path) -> None:
    model = write_model(tmp_path, LOG, "k = 1e3, q = 20.0")
    assert read_run_config(write_profile(tmp_path, model)).model.effects


@pytest.mark.parametrize("k", ["1e14", "-1e14"])
@pytest.mark.parametrize(("force", "what"), [("k * u", "stiffness"), ("k * 0.1 * v", "damping")])
def test_law_too_steep_for_the_rate_is_refused(
    tmp_path: Path, k: str, force: str, what: str
) -> None:
    model = write_model(tmp_path, force, f"k = {k}")
    if what == "damping":
        own = tmp_path / "own.toml"
        own.write_text(own.read_text().replace('"N/m"', '"N s/m"'))
    with pytest.raises(InputError, match=f"its {what} reaches 1e\\+1[34] .*1000 Hz"):
        read_run_config(write_profile(tmp_path, model))


def make_failing_model(folder: Path) -> Model:
    """Return a model whose law is not finite from 2.08 mm on, as a replay may be given one."""
    config, _ = load_model_config(write_model(folder, LOG, "k = 1e3, q = 480.0"))
    return config.build_model(read_run_config(write_profile(folder, "snm")).profile.specimen)


def test_twin_that_fails_departs_and_has_no_score(tmp_path: Path) -> None:
    model = make_failing_model(tmp_path)
    events = []
    for block in (50, 20):  # no result depends on the blocks
        config = replace(read_run_config(write_profile(tmp_path, "snm", block)), model=model)
        path = tmp_path / f"run{block}.mcap"
        items: list[Item] = []
        play_unpaced(config, "own", path, lambda: None, items.append)
        recording = read_recording(path)
        events.append([e for e in recording.records(Event) if e.kind == "twin_failed"])
    assert events[0] == events[1]
    predicted = join_blocks(
        [item for item in items if isinstance(item, Block) and item.stream == "pred"]
    )
    assert len(events[0]) == 2
    for event in events[0]:
        name = "free" if "free-running" in event.text else "window"
        rows = [row for row, each in enumerate(predicted.channels) if each.startswith(name)]
        is_finite = np.asarray(np.isfinite(predicted.values[rows]).all(axis=0))
        assert f"failed from sample {event.index}" in event.text
        assert list(is_finite[event.index - 1 : event.index + 1]) == [True, False]
    summary = summarise(recording, config.parameters)
    verdict = summary.twin_verdict
    assert verdict is not None
    assert verdict.verdict == "departs"
    assert "failed from sample" in verdict.reason
    assert verdict.misfit is None
    assert summary.comparison["rel_disp_m"].free_nrmse is None
    assert summary.comparison["rel_disp_m"].nrmse is None


def test_simulated_twin_that_fails_says_from_which_sample(tmp_path: Path) -> None:
    model = make_failing_model(tmp_path)
    config = replace(read_run_config(write_profile(tmp_path, "snm")), model=model)
    simulate_ideal(config, "own", tmp_path / "run.mcap", lambda _: None)
    recording = read_recording(tmp_path / "run.mcap")
    (event,) = (e for e in recording.records(Event) if e.kind == "twin_failed")
    predicted = join_blocks(recording.contiguous_blocks("pred"))
    assert np.isfinite(predicted.values[:8, : event.index]).all()
    assert not np.isfinite(predicted.values[:8, event.index]).all()


def test_lost_samples_are_no_failure_of_the_twin(tmp_path: Path) -> None:
    config = read_run_config(write_profile(tmp_path, "snm"))
    fault = '\n[[simulated.faults]]\nkind = "dropped"\nat_s = 3.0\nfor_s = 0.1\n'
    path = tmp_path / "run.mcap"
    rig = tmp_path / "rig.toml"
    rig.write_text(config.rig_toml + fault)
    config = read_run_config(write_profile(tmp_path, "snm"), str(rig))
    play_unpaced(config, "own", path, lambda: None, lambda _: None)
    recording = read_recording(path)
    assert not [e for e in recording.records(Event) if e.kind == "twin_failed"]


def test_law_without_a_static_equilibrium_is_refused_in_words(tmp_path: Path) -> None:
    """Its pole, -1 / q, is at a place where the equilibrium is sought: that of the gap."""
    model = write_model(tmp_path, "k * (1e-3 / q + u / (1 + u * q))", "k = 1e3, q = 500.0")
    own = load_model_config(model)[0].build_model(
        read_run_config(write_profile(tmp_path, "snm")).profile.specimen
    )
    with pytest.raises(InputError, match=r"effect 'own'.*no static equilibrium"):
        prepare_solver(own, 1000.0).rest_state()
