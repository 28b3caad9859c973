"""Brute-force bifurcation diagrams, Poincare sections and chaotic bands of the SNM."""

import numpy as np
import pytest

from table_io.errors import InputError
from tests.model.reference import AG, snm
from twin.dynamics.basins import StartGrid, compute_basins
from twin.dynamics.brute_force import (
    compute_exponent,
    find_chaotic_bands,
    follow_attractor,
    record_section,
    scan_attractors,
)
from twin.dynamics.stroboscopic import OperatingPoint
from twin.model.model import Model

G4 = OperatingPoint(Model(snm()), 1.2, AG)


@pytest.mark.slow
def test_the_chaotic_bands_of_g4():
    """1.07 to 1.17, 1.19 to 1.22 and 1.23 to 1.41 Hz."""
    frequencies = np.arange(1055, 1430, 10) / 1000
    up = follow_attractor(G4, "frequency", frequencies, 1000)
    down = follow_attractor(G4, "frequency", frequencies[::-1], 1000)
    bands = find_chaotic_bands([up, down], 1e-3)
    ends = [(band.low, band.high) for band in bands]
    assert ends == [
        pytest.approx(want, abs=4e-3) for want in ((1.066, 1.170), (1.190, 1.221), (1.226, 1.4135))
    ]
    assert all(band.exponent.is_positive for band in bands)


def test_a_band_that_reaches_the_end_of_the_diagram_ends_there():
    up = follow_attractor(G4, "frequency", [1.10, 1.11, 1.12], 500)
    (band,) = find_chaotic_bands([up], 1e-3)
    assert (band.low, band.high) == (1.10, 1.12)


def test_the_state_is_carried_through_the_hysteresis():
    frequencies = np.arange(270, 421, 5) / 100
    up = follow_attractor(G4, "frequency", frequencies)
    down = follow_attractor(G4, "frequency", frequencies[::-1])
    impacting = [
        {
            round(float(f), 3)
            for f, (a,) in zip(d.values, d.attractors, strict=True)
            if a.has_contact
        }
        for d in (up, down)
    ]
    assert max(impacting[0]) == pytest.approx(4.0273, abs=0.05)
    assert max(impacting[1]) == pytest.approx(2.7873, abs=0.05)


def test_many_starts_find_both_sides_of_the_hysteresis():
    scan = scan_attractors(
        G4, "frequency", [2.6, 3.4, 4.2], StartGrid.from_limits(6e-3, 0.15, 5, 5)
    )
    assert [len(attractors) for attractors in scan.attractors] == [1, 2, 1]


def test_over_the_gap_the_impacts_end_at_the_fold():
    """At 3.4 Hz: grazing at 2.4938 mm (decreasing gap), fold at 7.9502 mm (increasing gap)."""
    point = OperatingPoint(Model(snm(2e-3)), 3.4, AG)
    gaps = np.arange(200, 851, 10, dtype=np.float64) * 1e-5
    ends = []
    for values in (gaps, gaps[::-1]):
        diagram = follow_attractor(point, "gap", values)
        contacts = [a.has_contact for (a,) in diagram.attractors]
        ends.append(max(np.compress(contacts, diagram.values)))
    assert ends == pytest.approx([7.9502e-3, 2.4938e-3], abs=1e-4)


def test_a_subharmonic_of_small_basin_is_found():
    """4.55 Hz: period 6, a doubled period 3, beside the motion without contact."""
    basins = compute_basins(
        OperatingPoint(Model(snm()), 4.55, AG), StartGrid.from_limits(6e-3, 0.15, 25, 25)
    )
    assert basins.undecided_share == 0
    assert {attractor.period for attractor in basins.attractors} == {1, 6}


def test_a_section_lies_on_the_attractor():
    points = record_section(G4.with_parameter("frequency", 1.1), 1e-3, 0.0, 3000)
    assert points.shape == (3000, 2)
    assert np.unique(np.round(points, 9), axis=0).shape[0] > 2900
    periodic = record_section(G4.with_parameter("frequency", 1.18), 1e-3, 0.0, 50)
    assert np.unique(np.round(periodic, 7), axis=0).shape[0] == 5


def test_the_exponent_of_a_regular_motion_is_negative():
    exponent = compute_exponent(G4.with_parameter("frequency", 2.4), 1e-3, 0.0, 4000)
    assert exponent.is_negative
    assert not exponent.is_positive


def test_diagrams_over_different_values_have_no_common_bands():
    first = follow_attractor(G4, "frequency", [2.0])
    with pytest.raises(InputError) as error:
        find_chaotic_bands([first, follow_attractor(G4, "frequency", [2.1])], 1e-3)
    assert error.value.key == "diagrams"
