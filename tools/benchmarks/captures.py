"""Import captures of mixed kinds whose truth is known, and count what is read, refused, and read wrongly.

python tools/benchmarks/captures.py [--count 500] [--seed 0]

Each is written by captures_written.py, which shares no code with the importer, and its scene is read back by
captures_read.py with the standard library and SciPy.
"""

from __future__ import annotations

import tempfile
from collections import Counter
from pathlib import Path

from captures_read import count_one

from mambaloc.console import OptionParser, exit_on_input_error

COUNTED = ("captures", "refused", "tracebacks", "should", "read", "equal", "silent")
"""Captures, and frames: that should be read, that were, with their true pose, and with another or none."""


@exit_on_input_error
def main() -> None:
    """Print counts by kind and in all, and what was refused."""
    parser = OptionParser(description=__doc__)
    parser.add_argument("--count", type=int, default=500, help="captures")
    parser.add_argument("--seed", type=int, default=0, help="of the first")
    args = parser.parse_args()
    by_kind: dict[str, Counter[str]] = {}
    for seed in range(args.seed, args.seed + args.count):
        with tempfile.TemporaryDirectory() as folder:
            kind, counts, message = count_one(seed, Path(folder))
        by_kind[kind] = by_kind.get(kind, Counter()) + counts
        if message or counts["silent"] or counts["equal"] < counts["should"]:
            print(f"seed {seed}, {kind}: {dict(counts)} {message.replace(folder, '')}", flush=True)
    print(f"{'kind':16}", *(f"{name:>10}" for name in COUNTED))
    for kind, counts in [*by_kind.items(), ("all", sum(by_kind.values(), Counter()))]:
        print(f"{kind:16}", *(f"{counts[name]:10}" for name in COUNTED))


if __name__ == "__main__":
    main()
