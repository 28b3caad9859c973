"""Room for a recording: refused before a run, foreseen during it, kept in reserve for its end."""

from dataclasses import replace
from pathlib import Path

import pytest

from table_io.config.base import PROFILES_DIR
from tests.input_errors import raises_input_error
from twin.campaign.command import CampaignOptions, run_campaign
from twin.live import run_command as run
from twin.setup import disk
from twin.setup.disk import (
    DiskForecast,
    DiskReserve,
    bytes_per_s,
    free_bytes,
    planned_bytes,
    require_disk_space,
)
from twin.setup.run_config import RunConfig, read_run_config

QUICK = PROFILES_DIR / "tests" / "quickstart.toml"
ENDPOINT = "tcp/127.0.0.1:7447"


@pytest.fixture(scope="module")
def bundle() -> RunConfig:
    return read_run_config(QUICK)


def test_estimated_size_is_that_of_unpacked_data(bundle: RunConfig) -> None:
    # 9 measured channels, a tenth of the twin's 16, comparisons as 2, 8 bytes each, at 2 kHz
    assert bytes_per_s(bundle) == pytest.approx(2000 * 8 * (9 + 1.6 + 2))
    seconds = bundle.drive.planned_end / 2000
    assert planned_bytes(bundle) == pytest.approx(201_600 * (seconds + 60) + 50e6)


def test_tests_that_do_not_fit_together_are_refused(
    bundle: RunConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    needed = planned_bytes(bundle)
    monkeypatch.setattr(disk, "free_bytes", lambda _: 3 * needed - 1)
    require_disk_space([bundle] * 2, Path("runs/a"))
    with raises_input_error(where="runs/a", remedy="--out"):
        require_disk_space([bundle] * 3, Path("runs/a"))


def test_free_room_is_that_of_the_folder_to_be_made(tmp_path: Path) -> None:
    assert 0 < free_bytes(tmp_path / "not" / "yet") == pytest.approx(free_bytes(tmp_path), rel=0.1)
    assert free_bytes(Path("/proc/none")) > 1e15  # no disk: that nothing is written there is said


def test_a_full_disk_refuses_run_and_campaign_and_nothing_is_made(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(disk, "free_bytes", lambda _: 10_000_000)
    listed = tmp_path / "campaign.toml"
    listed.write_text(f'title = "One"\n[[runs]]\nprofile = "{QUICK}"\n')
    out = tmp_path / "out"
    for unpaced in (True, False):
        with raises_input_error(where=out, problem="10 MB"):
            run.run_test(QUICK, out, unpaced, None, None, False, ENDPOINT)
    asked = CampaignOptions(listed, out, False, True, None, None, True, ENDPOINT)
    with raises_input_error(where=out, problem="10 MB"):
        run_campaign(asked)
    assert not out.exists()
    out.mkdir()
    (out / "campaign.toml").write_text(listed.read_text())  # one that began
    with raises_input_error(where=out, problem="10 MB"):
        run_campaign(replace(asked, resume=True))


def test_filling_disk_is_announced_twice_in_time() -> None:
    room, rate = DiskForecast(1000.0), 250_000
    assert room.check(0, 0.0, 1) is None  # nothing is known yet
    assert room.check(10 * rate, 10.0, 991 * rate) is None
    warning = room.check(10 * rate, 10.0, 600 * rate)
    assert warning is not None
    assert "150 MB left on the disk: room for 600 s of recording, the test needs 990 s" in warning
    assert room.check(20 * rate, 20.0, 500 * rate) is None  # said once
    warning = room.check(400 * rate, 400.0, 119 * rate)
    assert warning is not None
    assert "room for 119 s" in warning
    assert room.check(410 * rate, 410.0, 50 * rate) is None
    assert DiskForecast(100.0).check(100 * rate, 100.0, 0) is None  # it is over


def test_a_reserve_holds_room_and_gives_it_back(tmp_path: Path) -> None:
    reserve = DiskReserve(tmp_path / "reserve", 1_000_000)
    assert (tmp_path / "reserve").stat().st_blocks * 512 >= 1_000_000
    DiskReserve(tmp_path / "reserve", 1_000_000)  # of a successor: the same one
    reserve.release()
    assert not (tmp_path / "reserve").exists()
    reserve.release()
    DiskReserve(
        tmp_path / "missing" / "reserve", 10
    ).release()  # what cannot be had is done without


def test_restarted_recorder_forecasts_as_its_predecessor() -> None:
    """It has written little itself, in a run that is old."""
    whole, successor, rate, free = DiskForecast(7200.0), DiskForecast(7200.0), 250_000, 200_000_000
    whole.check(0, 0.0, 10**12)
    successor.check(1000, 3540.0, 10**12)
    warning = whole.check(3600 * rate, 3600.0, free)
    assert warning is not None
    assert successor.check(1000 + 60 * rate, 3600.0, free) == warning
