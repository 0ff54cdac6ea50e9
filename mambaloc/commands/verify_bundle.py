"""Replay a bundle's frames through its models: mambaloc verify FOLDER [--threads N]. Needs no torch."""

from pathlib import Path

from mambaloc.console import OptionParser, exit_on_input_error, thread_count
from mambaloc.errors import InputError
from mambaloc.runtime.bundle import verify_bundle
from mambaloc.runtime.report import print_deviations


@exit_on_input_error
def main() -> None:
    """Print each model's deviation; exit with code 2 where one is larger than the bundle allows."""
    parser = OptionParser(description=__doc__)
    parser.add_argument("bundle", type=Path)
    parser.add_argument("--threads", type=thread_count, help="threads for an image")
    args = parser.parse_args()
    deviations = verify_bundle(args.bundle, args.threads)
    print_deviations(deviations)
    if bad := [each.file for each in deviations if not each.within]:
        raise InputError(f"{args.bundle}: {', '.join(bad)} deviates more than allowed; export the bundle again")
