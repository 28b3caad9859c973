"""numba's cache key: a kernel must not outlive a change in a module it calls into."""

from twin.model import phase
from twin.model.compiled import compiled, revision
from twin.model.sampled import march
from twin.model.sweep import stepped


def test_revision_follows_code_and_numbers():
    @compiled()
    def one(x: float) -> float:
        return 2.0 * x

    @compiled()
    def other(x: float) -> float:
        return 3.0 * x

    assert revision({"f": one}) == revision({"f": one, "text": "x"})
    assert len({revision({"f": one}), revision({"f": other}), revision({"f": one, "K": 1})}) == 3


def test_revision_of_the_phase_is_part_of_the_cache_keys():
    assert revision({k: v for k, v in vars(phase).items() if k != "REVISION"}) == phase.REVISION
    for kernel in (march, stepped):
        assert str(phase.REVISION) in str(kernel.signatures)
