"""Fault campaigns at full count: damage made on purpose, and whether anything wrong got through.

    python tests/campaigns/all_faults.py                          every campaign, hours
    python tests/campaigns/all_faults.py --scale 0.01             a hundredth of it
    python tests/campaigns/all_faults.py --only parsers,storage   only these
    python tests/campaigns/all_faults.py --only parsers --first 200000    further inputs, never tried before

Every fault is a function of its campaign and its number, so that one that got through can be made again.
Exits with 1 where a campaign failed, or was stopped (Ctrl-C shows what was counted so far).
"""

import argparse
import sys
from pathlib import Path

if __package__ in (None, ""):  # run as a script: `campaigns` is then not importable yet
    sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from campaigns.faults import (
    bombs,
    disks,
    interruptions,
    long_texts,
    parsers,
    storage,
    store_sequences,
    times,
    workers,
)
from campaigns.faults.outcome import HEADER, Outcome, total

CAMPAIGNS = {
    "parsers": parsers.campaign,
    "texts": long_texts.campaign,
    "bombs": bombs.campaign,
    "storage": storage.campaign,
    "sequences": store_sequences.campaign,
    "workers": workers.campaign,
    "kills": interruptions.kills,
    "calls": interruptions.calls,
    "races": interruptions.races,
    "time": times.campaign,
    "disks": disks.disks,
    "power": disks.cuts,
}
MOST_SHOWN = 10


def main(arguments: list[str] | None = None) -> int:
    # Run what the command line asks for, print the table, return the exit status
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--only", default=",".join(CAMPAIGNS), help="campaigns, separated by commas")
    parser.add_argument("--scale", type=float, default=1.0, help="fraction of the full count")
    parser.add_argument("--first", type=int, default=0, help="number of the first fault")
    asked = parser.parse_args(arguments)
    names = asked.only.split(",")
    if unknown := sorted(set(names) - set(CAMPAIGNS)):
        parser.error(f"no campaign {', '.join(unknown)}; there are {', '.join(CAMPAIGNS)}")
    print(HEADER, flush=True)
    failed = stopped = False
    for name in names:
        parts: list[Outcome] = []
        try:
            parts.extend(CAMPAIGNS[name](asked.scale, first=asked.first))
        except KeyboardInterrupt:
            stopped = True
        for outcome in total(parts):
            print("\n    ".join([str(outcome), *outcome.wrong[:MOST_SHOWN]]), flush=True)
            failed |= not outcome.good
        if stopped:
            print("stopped before its end: this is what was counted so far")
            break
    return int(failed or stopped)


if __name__ == "__main__":
    sys.exit(main())
