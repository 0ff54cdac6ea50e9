"""Export for apps: mambaloc export CHECKPOINT_OR_ZOO_NAME [--to onnx,fp16,int8,ort] [--target android]."""

from argparse import BooleanOptionalAction
from pathlib import Path

from mambaloc.console import OptionParser, configure_logging, exit_on_input_error
from mambaloc.errors import InputError
from mambaloc.export import FORMATS, TARGETS, write_bundle
from mambaloc.runtime.report import print_deviations
from mambaloc.zoo.bundles import load_with_data, map_of


@exit_on_input_error
def main() -> None:
    """Write a bundle and say how far each model is from PyTorch."""
    configure_logging()
    parser = OptionParser(description=__doc__)
    parser.add_argument("source", metavar="CHECKPOINT_OR_ZOO_NAME", help="RUN/checkpoints/best.ckpt, or ARCH.TAG")
    parser.add_argument("--to", default="onnx,fp16", help=f"of {', '.join(FORMATS)}, with commas")
    parser.add_argument("--target", default="android", choices=TARGETS, help="kind of app that INTEGRATION.md is for")
    parser.add_argument(
        "--raw-input", action=BooleanOptionalAction, default=True, help="resize, crop and scale inside the models"
    )
    maps = parser.add_mutually_exclusive_group()
    maps.add_argument("--map", type=Path, metavar="FILE", help="map to ship with the models (default: the run's)")
    maps.add_argument("--no-map", action="store_true", help="leave it out")
    parser.add_argument("--root", help="folder of the scene (default: as in training)")
    parser.add_argument("--out", type=Path, help="folder of the bundle (default: RUN/bundle or bundles/ZOO_NAME)")
    args = parser.parse_args()
    formats = tuple(dict.fromkeys(word.strip() for word in args.to.split(",")))
    if unknown := sorted(map(repr, set(formats) - set(FORMATS))):
        raise InputError(f"--to {args.to}: {', '.join(unknown)} is not one of {', '.join(FORMATS)}")
    system, data = load_with_data(args.source, args.root)
    is_run = Path(args.source).is_file()
    out = args.out or (
        Path(args.source).parent.parent / "bundle" if is_run else Path("bundles", Path(args.source).name)
    )
    sparse_map = None if args.no_map else args.map or map_of(args.source)
    written = write_bundle(system, data, out, formats, args.target, args.raw_input, sparse_map)
    print_deviations(written.deviations)
    print(*filter(None, [written.int8, written.unsure, f"wrote {out}"]), sep="\n")
