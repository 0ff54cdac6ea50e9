"""Export for apps: python tools/export.py CHECKPOINT [--to onnx,fp16,ort] [--target android] [--out FOLDER]."""

import argparse
from pathlib import Path

from mambaloc.console import exits_cleanly, quieten
from mambaloc.errors import InputError
from mambaloc.evaluation.evaluate import data_of
from mambaloc.export import FORMATS, TARGETS, write_bundle
from mambaloc.models import load_checkpoint
from mambaloc.models.base import read_checkpoint
from mambaloc.runtime.report import print_deviations


@exits_cleanly
def main() -> None:
    """Write a bundle and say how far each model is from PyTorch."""
    quieten()
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("checkpoint", type=Path)
    parser.add_argument("--to", default="onnx,fp16", help=f"of {', '.join(FORMATS)}, with commas")
    parser.add_argument("--target", default="android", choices=TARGETS, help="machine that ort is optimised for")
    parser.add_argument("--raw-input", action="store_true", help="resize, crop and scale inside of the models")
    parser.add_argument("--out", type=Path, help="folder of the bundle; RUN/bundle unless given")
    args = parser.parse_args()
    formats = tuple(dict.fromkeys(args.to.split(",")))
    if unknown := set(formats) - set(FORMATS):
        raise InputError(f"--to {args.to}: {', '.join(sorted(unknown))} is none of {', '.join(FORMATS)}")
    stored = read_checkpoint(args.checkpoint)
    out = args.out or args.checkpoint.parent.parent / "bundle"
    data = data_of(stored, args.checkpoint)
    print_deviations(write_bundle(load_checkpoint(args.checkpoint), data, out, formats, args.target, args.raw_input))
    print(f"wrote {out}")


if __name__ == "__main__":
    main()
