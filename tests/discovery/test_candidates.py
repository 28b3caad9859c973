"""Trial shapes of candidates: dense where a residual is sharply tuned, few where it is not."""

import numpy as np
import pytest

from tests.discovery.test_parameters import SCALE
from twin.discovery.candidates import Candidate
from twin.discovery.parameters import SLIP_SPEED
from twin.laws.library import find_effect


def test_an_appendage_is_tried_at_every_frequency_of_the_record() -> None:
    candidate = Candidate.from_effect(find_effect("appendage"), "", SCALE)
    hz, damping = np.array(candidate.shapes).T
    main_hz = 1.0 / (2 * np.pi * SCALE.time_s)
    assert hz[0] < 0.2 * main_hz
    assert hz[-1] == pytest.approx(0.1 / SCALE.sample_s)
    # a resonance of 5 % damping is 10 % wide
    assert (hz[1:] / hz[:-1] < 1.13).all()
    assert len(set(damping)) == 1
    assert candidate.amplitude.name == "appendage.mass"


def test_stribeck_friction_is_tried_in_all_combinations_of_its_shapes() -> None:
    candidate = Candidate.from_effect(find_effect("stribeck_friction"), "", SCALE)
    assert candidate.free[-1].key == SLIP_SPEED
    ratios, speeds, slips = (set(column) for column in zip(*candidate.shapes, strict=True))
    assert len(ratios) > 3
    assert len(speeds) > 3
    assert len(slips) == 1
    assert len(candidate.shapes) == len(ratios) * len(speeds)
    coulomb = Candidate.from_effect(find_effect("coulomb_friction"), "", SCALE)
    assert len(coulomb.shapes) == 4


def test_a_threshold_has_its_slope_taken_over_trial_values() -> None:
    adhesion = Candidate.from_effect(find_effect("adhesion"), "", SCALE)
    assert min(adhesion.probes) > 0.0
    assert max(adhesion.probes) < adhesion.amplitude.high
    assert Candidate.from_effect(find_effect("bumper_cubic"), "", SCALE).probes == (0.0,)
