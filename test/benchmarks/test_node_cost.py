"""What the cost of a node is read from, and what a soak calls a problem."""

from __future__ import annotations

import struct
from concurrent.futures import Future
from itertools import islice
from typing import Any

from benchmarks.node_cost import GAP_NS, STAMP, Recorded, Sample, laps, problems, row
from calib_ros.frame import NANOSECONDS
from calib_ros.online.pacing import Work


def sample(second: int, mb: float = 500.0, accepted: int = 1) -> Sample:
    counts = {"keyframes so far": second, "estimates accepted": accepted, "pairs": 10 * second, "worker load": 0.5}
    values = {name: str(value) for name, value in counts.items()} | {f"CPU for {work.value}": "0.1" for work in Work}
    values |= {"status": "converged" if second >= 30 else "initial", "callback 99th percentile, ms": "4.0"}
    values["pairs dropped by a busy worker"] = str(second)
    return Sample(second, second, [0.25 * second, 0.05 * second], [mb, 80.0], [values])


def test_laps_go_on_in_time_with_their_stamps_written_over() -> None:
    messages = [Recorded("/a", 7 * NANOSECONDS + k, bytearray(b"\0\1\0\0" + bytes(8))) for k in (0, 5)]
    played = [(at, *struct.unpack_from("<iI", message.data, STAMP)) for at, message in islice(laps(messages), 4)]
    stamps = [seconds * NANOSECONDS + rest for _, seconds, rest in played]
    assert stamps == [messages[0].stamp + offset for offset in (0, 5, 5 + GAP_NS, 10 + GAP_NS)]
    assert [at for at, *_ in played] == [(stamp - stamps[0]) / NANOSECONDS for stamp in stamps]


def test_a_row_has_shares_of_a_core_and_rates_of_what_came_after_the_settling() -> None:
    cells = [cell.strip() for cell in row("drive", [sample(k) for k in range(121)], 60).strip("|").split("|")]
    assert cells[:2] == ["drive", "0.25 0.25 0.25"]
    assert cells[3:] == ["60, 0", "10%", "30 s", "4.0", "500, 500", "0.050, 80"]


def test_a_soak_names_leaks_lost_answers_and_tracebacks() -> None:
    answered: Future[Any] = Future()
    answered.set_result(None)
    assert problems([sample(k) for k in range(601)], [answered], "") == []
    found = problems([sample(k, 500 + k, accepted=0) for k in range(601)], [Future()], "Traceback")
    assert [problem.split()[0] for problem in found] == ["memory", "1", "no", "the"]
