"""Recordings of specimens of another size than any model: nothing but the mass is stated."""

from dataclasses import dataclass
from pathlib import Path

import pytest

from tests.studies.evidence.imported import import_columns
from tests.studies.evidence.laboratory import Specimen, record
from tests.studies.evidence.worlds import Motion, draw_world, state_specimen
from twin.discovery.result import Verdict
from twin.discovery.task import discover


@dataclass(frozen=True)
class Judged:
    specimen: Specimen
    motion: Motion
    verdict: Verdict


def judge(seed: int, folder: Path) -> Judged:
    """Discover what a clean recording of a laboratory of the study lacks."""
    specimen, lab, motion, _, _ = draw_world(seed)
    columns = record(specimen, lab, seed, motion)
    log = import_columns(columns, folder, settings=state_specimen(specimen, lab))
    return Judged(specimen, motion, discover([log]).verdict)


@pytest.fixture(scope="module")
def swept(tmp_path_factory: pytest.TempPathFactory) -> Judged:
    """A mass between bumpers under a sweep, from rest."""
    return judge(16, tmp_path_factory.mktemp("swept"))


@pytest.fixture(scope="module")
def shaken(tmp_path_factory: pytest.TempPathFactory) -> Judged:
    """The same under random motion, cut out of it, behind anti-alias filters."""
    return judge(25, tmp_path_factory.mktemp("shaken"))


@pytest.mark.parametrize("name", ["swept", "shaken"])
def test_a_specimen_of_another_size_lacks_no_effect(
    name: str, request: pytest.FixtureRequest
) -> None:
    judged: Judged = request.getfixturevalue(name)
    verdict = judged.verdict
    assert (verdict.verdict, [effect.id for effect in verdict.effects]) == ("none", [])
    truth = {
        "stiffness": judged.specimen.k, "damping": judged.specimen.c,
        "bumper_stiffness": judged.specimen.kb, "bumper_damping": judged.specimen.cb,
    }  # fmt: skip
    for key, value in truth.items():
        estimate = verdict.base[key]
        assert estimate.high is not None
        # twice the half width of 95 %, which four estimates of two logs may leave
        assert abs(estimate.value - value) < 2.0 * (estimate.high - estimate.value), key


def test_load_cells_show_a_gap_that_no_one_stated(swept: Judged, shaken: Judged) -> None:
    for judged in (swept, shaken):
        (note,) = [note for note in judged.verdict.notes if "gap is not stated" in note]
        numbers = [float(word) for word in note.replace("mm", " ").split() if word[0].isdigit()]
        half = 0.5 * judged.specimen.gap_mm
        assert numbers == pytest.approx([half, half, 2 * half], rel=0.02)


def test_unknown_noise_is_said(swept: Judged, shaken: Judged) -> None:
    is_said = [
        any("no repeated cycle shows the noise" in note for note in judged.verdict.notes)
        for judged in (swept, shaken)
    ]
    assert is_said == [False, True]


def test_bumpers_whose_contacts_a_filter_hides_are_not_judged(tmp_path: Path) -> None:
    judged = judge(5, tmp_path)
    verdict = judged.verdict
    assert "bumper_stiffness" not in verdict.base
    assert any("the bumpers are not judged" in note for note in verdict.notes)
    assert not {"bumper_hardening", "hunt_crossley"} & {size.id for size in verdict.excludes}
    assert "filters settle" in verdict.fell_away["bumper_hardening"]


def test_a_record_cut_out_of_a_motion_leaves_noise_without_a_mass_accelerometer(
    tmp_path: Path,
) -> None:
    """The noise of the laser's second derivative, cut off sharply, is a force for seconds."""
    verdict = judge(406, tmp_path).verdict
    assert verdict.verdict == "none"
    assert verdict.gap.held_out_after < 1.1
