"""Damaged files of every format through what `import` reads: what comes of each.

    python -m tests.studies.damaged_formats [FILES]

So many mutants of every format (100), each by its number the same again: bytes changed, cut out,
put in, moved, a number made huge, the end cut off. A file is read, or refused in one sentence;
anything else is printed with its number, and the exit code is 1.
"""

import random
import resource
import sys
import traceback
from collections import Counter
from pathlib import Path
from tempfile import TemporaryDirectory
from time import process_time

from table_io.errors import InputError
from table_io.formats import read_table
from tests.table_io.formats.test_formats import FORMATS
from twin.exchange.columns import ColumnMap, read_samples

HEAD_BYTES = 4000  # bytes in which half of the changes lie: there stands what a file says of itself
ODD = (0, 0x7F, 0x80, 0xFF)
HUGE = (b"\xff" * 8, bytes(8), (2**62).to_bytes(8, "little"), (2**31 - 1).to_bytes(4, "big") * 2)


def mutant(data: bytes, seed: str) -> bytes:
    """The file with one kind of damage; the same for the same seed."""
    rng = random.Random(seed)
    out = bytearray(data)
    zone = len(out) if rng.random() < 0.5 else min(HEAD_BYTES, len(out))
    at, size = rng.randrange(zone), rng.randrange(1, 300)
    kind = rng.choice(("bytes", "bytes", "bytes", "cut", "huge", "less", "more", "moved"))
    if kind == "bytes":
        for _ in range(rng.choice((1, 1, 2, 5, 20))):
            out[rng.randrange(zone)] = rng.choice((*ODD, rng.randrange(256)))
    elif kind == "cut":
        del out[rng.randrange(len(out)) :]
    elif kind == "huge":
        out[at : at + 8] = rng.choice(HUGE)
    elif kind == "less":
        del out[at : at + size]
    elif kind == "more":
        out[at:at] = rng.randbytes(size)
    else:
        source = rng.randrange(len(out))
        out[at : at + size] = out[source : source + size]
    return bytes(out)


def outcome(path: Path, card: ColumnMap) -> str:
    """What comes of a file, in a word or a sentence."""
    try:
        read_samples(read_table(path, card.group), card)
    except InputError as error:
        lost = "its reader crashed" in str(error)
        return "refused, its reader died" if lost else "refused"
    except Exception:
        return traceback.format_exc()
    return "read"


def main() -> int:
    """Prints a line a format; the exit code."""
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 100
    wrong = 0
    with TemporaryDirectory() as folder:
        for kind, (name, write, text) in FORMATS.items():
            path, card = Path(folder) / name, ColumnMap.model_validate(text)
            path.unlink(missing_ok=True)
            write(path)
            data = path.read_bytes()
            counts: Counter[str] = Counter()
            slowest = 0.0
            for number in range(count):
                path.write_bytes(mutant(data, f"{kind} {number}"))
                begun = process_time()
                came = outcome(path, card)
                slowest = max(slowest, process_time() - begun)
                counts[came] += 1
                if came.startswith("Traceback"):
                    wrong += 1
                    print(f"{kind}, mutant {number}: {came}")
            summary = ", ".join(f"{times} {what.splitlines()[0]}" for what, times in counts.items())
            print(f"{kind:10} {summary}; slowest {slowest:.2f} s of CPU", flush=True)
    for who, which in (("we", resource.RUSAGE_SELF), ("readers", resource.RUSAGE_CHILDREN)):
        print(f"{who}: {resource.getrusage(which).ru_maxrss / 1024:.0f} MB at the most")
    return int(wrong > 0)


if __name__ == "__main__":
    raise SystemExit(main())
