"""Train many recipes and report: mambaloc sweep run SWEEP.yaml, mambaloc sweep report RESULTS."""

import argparse
from importlib.util import find_spec
from pathlib import Path

from mambaloc.console import OptionParser, configure_logging, exit_on_input_error
from mambaloc.sweep import Store, print_plan, read_sweep, run_sweep


@exit_on_input_error
def main() -> None:
    """Run trials, or report what ended."""
    configure_logging()
    parser = OptionParser(description=__doc__)
    parts = parser.add_subparsers(required=True)
    part = parts.add_parser("run", help="train and evaluate every trial of a sweep that has not finished")
    part.add_argument("sweep", type=Path, help="a file like those in recipes/sweeps/")
    part.add_argument("--out", type=Path, help="folder for results.sqlite and runs/ (default: runs/sweeps/NAME)")
    part.add_argument("--address", help="of a Ray cluster whose machines share --out")
    part.add_argument("--retry-failed", action="store_true", help="run failed trials again")
    part.add_argument("--dry-run", action="store_true", help="list the trials and their resources")
    part.set_defaults(call=_run)
    part = parts.add_parser("report", help="write a sweep's results with the paper's tables")
    part.add_argument("results", type=Path, help="folder that mambaloc sweep run wrote")
    part.add_argument("--compare", nargs=3, action="append", default=[], metavar=("AXIS", "BEFORE", "AFTER"))
    part.add_argument("--epoch", default="last", choices=("last", "best"))
    part.add_argument(
        "--reach", type=float, metavar="METRES", help="position error for which to report training seconds"
    )
    part.add_argument("--out", type=Path, help="folder to write (default: RESULTS/report)")
    part.set_defaults(call=_report)
    args = parser.parse_args()
    args.call(args)


def _run(args: argparse.Namespace) -> None:
    sweep, out = read_sweep(args.sweep), args.out or Path("runs/sweeps", args.sweep.stem)
    if args.dry_run:
        print_plan(sweep, Store.ended(out))
        return
    if args.address is None and find_spec("torch") is None:  # before each trial fails of it
        raise ModuleNotFoundError("trials train on this machine", name="torch")
    ended = run_sweep(sweep, out, args.address, args.retry_failed)
    print(f"{out}: {ended['done']} trials done, {ended['failed']} failed, {ended['found']} from before")


def _report(args: argparse.Namespace) -> None:
    from mambaloc.sweep.report import write_report  # needs torch, which running does not

    out = args.out or args.results / "report"
    rows, failed = write_report(args.results, out, args.compare, args.epoch, args.reach)
    print(f"{out}: report.html, report.md, tables/, plots/; {len(rows)} rows, {len(failed)} trials failed")
