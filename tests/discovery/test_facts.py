"""Facts: the slow components of a residual in each block, in place of its samples."""

import numpy as np
import pytest

from twin.compare.hum import HUM_LASTING_S
from twin.discovery.facts import BlockBasis

RATE_HZ = 200.0


def basis(sizes: list[int], band_hz: float = 20.0, hum_hz: tuple[float, ...] = ()) -> BlockBasis:
    """The components of blocks of these numbers of samples."""
    blocks = np.repeat(np.arange(len(sizes)), sizes)
    return BlockBasis(blocks, RATE_HZ, band_hz, np.arange(blocks.size), hum_hz)


def test_components_up_to_the_nyquist_frequency_keep_every_product() -> None:
    whole = basis([50, 33, 200, 1], 0.5 * RATE_HZ)
    rng = np.random.default_rng(0)
    a, b = rng.standard_normal((2, 284))
    assert whole.size == 284
    assert whole.project(a) @ whole.project(b) == pytest.approx(a @ b)


def test_white_noise_stays_white_with_its_level() -> None:
    own = basis([100] * 400)
    facts = own.project(np.random.default_rng(1).standard_normal(40_000))
    by_order = [facts[own.order == k].std() for k in range(int(own.counts[0]))]
    assert by_order == pytest.approx(np.ones(len(by_order)), abs=0.15)


def test_a_cosine_of_a_component_is_that_component_alone() -> None:
    own = basis([80, 80])
    n = np.arange(80)
    values = np.concatenate([np.zeros(80), np.cos(np.pi / 80 * (n + 0.5) * 6)])
    facts = own.project(values)
    (place,) = np.flatnonzero(np.abs(facts) > 1e-9)
    assert own.order[place] == 6
    assert own.frequency_hz[place] == pytest.approx(0.5 * RATE_HZ * 6 / 80)
    assert own.middle[place] == 80 + 40


def test_only_components_within_the_band_are_facts() -> None:
    own = basis([40, 160], 20.0)
    assert own.frequency_hz.max() <= 20.0
    assert own.counts.tolist() == [9, 33]
    fast = np.sin(2 * np.pi * 70.0 * np.arange(200) / RATE_HZ)
    assert np.linalg.norm(own.project(fast)) < 0.15 * np.linalg.norm(fast)


def test_facts_tell_nothing_of_hum_that_beats_and_all_of_the_rest() -> None:
    """As the machines of a hall beat; the blocks are cycles of a drive with a harmonic there."""
    sizes, hum_hz = [100] * 40, 50.0
    time_s = np.arange(4000) / RATE_HZ
    hum = (1.0 + 0.5 * np.sin(2 * np.pi * 0.3 * time_s)) * np.sin(2 * np.pi * hum_hz * time_s + 0.4)
    plain, deaf = basis(sizes, 90.0), basis(sizes, 90.0, (hum_hz,))
    assert np.sum(deaf.project(hum) ** 2) < 2e-3 * np.sum(plain.project(hum) ** 2)
    noise = np.random.default_rng(3).standard_normal(4000)
    lost = 1.0 - np.sum(deaf.project(noise) ** 2) / np.sum(plain.project(noise) ** 2)
    assert lost == pytest.approx(4 / (90.0 * HUM_LASTING_S * 2), rel=0.5)
    motion = np.sin(2 * np.pi * 44.0 * time_s)
    assert np.sum(deaf.project(motion) ** 2) > 0.97 * np.sum(plain.project(motion) ** 2)
