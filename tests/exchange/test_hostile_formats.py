"""What a hostile or damaged file may do to us: nothing but be refused, in one sentence."""

import os
import signal
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.io import savemat

from table_io import formats
from table_io.errors import InputError
from table_io.formats import read_table, sandbox
from tests.exchange.test_formats import uff
from tests.input_errors import raises_input_error
from twin.exchange.columns import ColumnMap, read_samples

h5py = pytest.importorskip("h5py")
pa = pytest.importorskip("pyarrow")
pq = pytest.importorskip("pyarrow.parquet")

RATE, N = 200.0, 400
TIME = np.arange(N) / RATE


def with_dataset(path: Path, **options: Any) -> None:
    with h5py.File(path, "w") as file:
        file.create_dataset("u", **options)


def bomb_of_zeros(path: Path) -> None:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        header = b"{'descr': '<f8', 'fortran_order': False, 'shape': (500000000,), }"
        archive.writestr("u.npy", b"\x93NUMPY\1\0\x76\0" + header.ljust(117) + b"\n" + bytes(2**20))


def packed_bomb(path: Path) -> None:
    savemat(path, {"u": np.zeros(8)})
    body = zlib.compress(bytes(100 * 2**20))
    with path.open("ab") as file:
        file.write((15).to_bytes(4, "little") + len(body).to_bytes(4, "little") + body)


def elsewhere(path: Path) -> None:
    with_dataset(path, shape=(N,), dtype="f8", external=[("/etc/passwd", 0, 8 * N)])


def fewer(path: Path) -> None:
    """A set that has fewer values than it says."""
    uff(path, 0)
    path.write_bytes(path.read_bytes().replace(b"       400", b"       500", 1))


HOSTILE: dict[str, tuple[str, Callable[[Path], object], str]] = {
    "complex": ("a.h5", lambda p: with_dataset(p, data=1j * TIME), "complex"),
    "text": ("a.h5", lambda p: with_dataset(p, data=[b"a"] * N), "text"),
    "cube": ("a.h5", lambda p: with_dataset(p, data=np.zeros((9, 9, 9))), "9 x 9 x 9"),
    "wide": ("a.h5", lambda p: with_dataset(p, data=np.zeros((99, 99))), "99 x 99"),
    "one": ("a.h5", lambda p: with_dataset(p, data=np.zeros(1)), "a single value"),
    "empty": ("a.h5", lambda p: with_dataset(p, data=np.zeros(0)), "empty"),
    "other file": ("a.h5", elsewhere, "in another file"),
    "infinite": ("a.h5", lambda p: with_dataset(p, data=np.full(N, np.inf)), "row 1, column 'u'"),
    "large integers": (
        "a.h5",
        lambda p: with_dataset(p, data=np.full(N, 2**60)),
        "integers beyond 2^53",
    ),
    "huge": (
        "a.h5",
        lambda p: with_dataset(p, shape=(2**40,), dtype="f8", chunks=(2**10,)),
        "1099511627776 numbers",
    ),
    "huge chunk": (
        "a.h5",
        lambda p: with_dataset(p, shape=(2**28,), dtype="f8", chunks=(2**28,)),
        "chunks of more than",
    ),
    "zip bomb": ("a.npz", bomb_of_zeros, "500000000 numbers"),
    "mat bomb": ("a.mat", packed_bomb, "200 times its size"),
    "pickle": ("a.npz", lambda p: np.savez(p, u=np.array([{}] * N, object)), "objects"),
    "strings": ("a.parquet", lambda p: pq.write_table(pa.table({"u": ["1"] * N}), p), "string"),
    "another format": ("a.tdms", lambda p: p.write_bytes(b"a,b\n1,2\n"), "not a LabVIEW TDMS file"),
    "nothing": ("a.mat", lambda p: p.write_bytes(b""), "damaged"),
    "fewer values": ("a.uff", fewer, "500 values and has 400"),
    "no 58": ("a.uff", lambda p: p.write_text("    -1\n   151\nx\n    -1\n"), "no set of type 58"),
}


@pytest.mark.parametrize("kind", HOSTILE)
def test_hostile_files(tmp_path: Path, kind: str) -> None:
    name, write, words = HOSTILE[kind]
    write(tmp_path / name)
    mapped = ColumnMap.model_validate(
        {"rate_hz": RATE, "columns": {"rel_disp_m": {"column": "u", "unit": "mm"}}}
    )
    with pytest.raises(InputError) as caught:
        read_samples(read_table(tmp_path / name), mapped)
    assert words in str(caught.value)
    assert name in str(caught.value)


def test_a_library_that_is_not_there_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def absent(name: str) -> Any:
        raise ModuleNotFoundError("No module named 'h5py'", name="h5py")

    monkeypatch.setattr(formats, "import_module", absent)
    (tmp_path / "a.h5").touch()
    with raises_input_error(where=tmp_path / "a.h5", problem="h5py", remedy='"shaketwin[formats]"'):
        read_table(tmp_path / "a.h5")


def crash() -> None:
    os.kill(os.getpid(), signal.SIGSEGV)


def swell() -> int:
    return len(bytearray(2**36))


def spin() -> None:
    while True:
        pass


@pytest.mark.parametrize(
    ("work", "words"), [(crash, "crashed"), (swell, "too large"), (spin, "hung"), (os.abort, "cra")]
)
def test_a_reader_that_dies_does_not_take_us_along(
    tmp_path: Path, work: Callable[[], Any], words: str
) -> None:
    (tmp_path / "x").touch()
    with raises_input_error(where=tmp_path / "x", problem=words):
        sandbox.run_isolated(tmp_path / "x", work, max_cpu_s=1)
