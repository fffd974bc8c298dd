# SPDX-License-Identifier: Apache-2.0
"""Both nodes for a long time, with checkpoints: memory, latency and losses by the minute.

``--kill`` ends one of the nodes with SIGKILL now and then and starts it again.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

import numpy as np
from common import machine, table
from live import CELLS, SECOND_NS, SITES, Flight, fly, latencies_ms, report, write_script

MINUTE_S = 60.0


def by_the_minute(flight: Flight) -> None:
    """One row a minute: latency, losses so far, processor time, memory."""
    start = int(flight.sent[0])
    usage = list(flight.usage.values())
    rows = []
    for minute in range(int((flight.sent[-1] - start) / (MINUTE_S * SECOND_NS)) + 1):
        first = start + round(minute * MINUTE_S * SECOND_NS)
        last = first + round(MINUTE_S * SECOND_NS)
        sent = flight.sent[(flight.sent >= first) & (flight.sent < last)]
        row = [f"{minute + 1}", f"{len(sent)}"]
        for topic in (CELLS, SITES):
            of_messages, _ = latencies_ms(sent, flight.observed.received[topic])
            row += [f"{np.percentile(of_messages, 95):.0f}" if len(of_messages) else "-"]
        for each in usage:
            seconds = np.array(each.seconds) - each.seconds[0]
            inside = np.flatnonzero(
                (seconds >= minute * MINUTE_S) & (seconds < (minute + 1) * MINUTE_S)
            )
            if len(inside) < 2:
                row += ["-", "-"]
                continue
            a, b = inside[0], inside[-1]
            share = 100.0 * (each.cpu[b] - each.cpu[a]) / (seconds[b] - seconds[a])
            row += [f"{share:.0f}", f"{each.memory_mb[b]:.0f}"]
        rows.append(row)
    head = ["minute", "scans", "cells p95 ms", "sites p95 ms"]
    for name in flight.usage:
        head += [f"{name} %", "MB"]
    table("By the minute", head, rows)


def main() -> None:
    """Fly for long and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=3.0)
    parser.add_argument("--seed", type=int, default=102)
    parser.add_argument("--kill", type=float, default=0.0, metavar="S", help="every S seconds")
    options = parser.parse_args()
    print(machine())
    with tempfile.TemporaryDirectory() as folder:
        extra = ["-p", f"checkpoint.path:={folder}/checkpoint.map"]
        script = write_script(options.seed)
        flight = fly(
            script, options.minutes * MINUTE_S, Path(folder), extra=extra, kill_every=options.kill
        )
    by_the_minute(flight)
    report(flight)


if __name__ == "__main__":
    main()
