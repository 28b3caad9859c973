"""Cases on a few processes, each result as it comes. A process that dies loses only its case."""

import multiprocessing
import os
import signal
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from typing import Any

from table_io.clock import RealClock

LOOK_S = 0.2  # how often it is asked whether to stop
LONGEST_S = 900.0  # for one case; beyond it the process is ended
Work = Callable[[int], dict[str, Any]]  # at the top of a module: it is sent to a new process


@dataclass(slots=True)
class _Hand:
    """A process and the number that it works on."""

    process: BaseProcess
    pipe: Connection
    number: int
    since: float


def by_crew(
    numbers: Iterable[int], workers: int, work: Work, stop: Callable[[], object]
) -> Iterator[dict[str, Any]]:
    """`work(number)` of every number, in the order in which they are done.

    Once `stop()` is true none is begun any more; those under way are finished and handed out.
    """
    os.environ |= {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
    waiting, clock = deque(numbers), RealClock()
    hands: list[_Hand] = []
    try:
        while waiting and len(hands) < workers and not stop():
            hands.append(_hired(work, waiting.popleft(), clock.now()))
        while hands:
            ready = wait([hand.pipe for hand in hands], timeout=LOOK_S)
            for hand in list(hands):
                late = clock.now() - hand.since > LONGEST_S
                if hand.pipe not in ready and not late:
                    continue
                row = _row(hand, late)
                hands.remove(hand)
                if waiting and not stop():
                    hands.append(_next(hand, work, waiting.popleft(), clock.now()))
                else:
                    _dismissed(hand)
                yield row
    finally:
        for hand in hands:
            hand.process.terminate()


def _row(hand: _Hand, late: bool) -> dict[str, Any]:
    """What a hand has to say, or why it says nothing."""
    if late:
        hand.process.terminate()
        hand.process.join()
        why = f"took longer than {LONGEST_S:g} s"
    else:
        try:
            return dict(hand.pipe.recv())
        except (EOFError, OSError):
            hand.process.join()
            why = f"its process died (exit code {hand.process.exitcode})"
    return {"number": hand.number, "failed": why}


def _hired(work: Work, number: int, now: float) -> _Hand:
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=_worked, args=(theirs, work), daemon=True)
    process.start()
    theirs.close()  # so that its end is seen when the process dies
    ours.send(number)
    return _Hand(process, ours, number, now)


def _next(hand: _Hand, work: Work, number: int, now: float) -> _Hand:
    """The same hand with its next number, or a new one where it is gone."""
    if hand.process.is_alive():
        try:
            hand.pipe.send(number)
            return _Hand(hand.process, hand.pipe, number, now)
        except OSError:
            pass
    hand.pipe.close()
    return _hired(work, number, now)


def _dismissed(hand: _Hand) -> None:
    hand.pipe.close()
    hand.process.join()


def _worked(pipe: Connection, work: Work) -> None:
    """The life of a process: numbers in, rows out, until nobody is there any more.

    Ctrl-C reaches every process of a terminal; only the first one acts on it.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        while True:
            pipe.send(work(pipe.recv()))
    except (EOFError, OSError):
        return
