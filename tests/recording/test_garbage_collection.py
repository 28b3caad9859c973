"""The collection of reference cycles is paused inside, and as before outside."""

import gc

import pytest

from twin.recording.recovery import pause_collection


def test_it_goes_on_after_the_outermost_pause() -> None:
    assert gc.isenabled()
    with pause_collection():
        with pause_collection():
            assert not gc.isenabled()
        assert not gc.isenabled()
    assert gc.isenabled()


def test_an_error_ends_the_pause() -> None:
    with pytest.raises(ValueError, match="inside"), pause_collection():
        raise ValueError("inside")
    assert gc.isenabled()
