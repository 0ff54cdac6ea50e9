"""Measure the library: python tools/benchmark.py loading|sizes [--dataset 7scenes --root FOLDER --scene NAME]."""

import argparse
from statistics import median

from mambaloc import create_model, provenance
from mambaloc.benchmark import measure_loading, published_accounting
from mambaloc.console import exits_cleanly, quieten
from mambaloc.data import PoseDataModule


@exits_cleanly
def main() -> None:
    """Measure and print."""
    quieten()
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", choices=("loading", "sizes"))
    parser.add_argument("--dataset", default="embedded")
    parser.add_argument("--root")
    parser.add_argument("--scene", default="heads")
    args = parser.parse_args()
    if args.what == "sizes":
        for gis in ("gis", "none"):
            counts = published_accounting(create_model("mambaloc", gis=gis).network)
            print(f"mambaloc, gis: {gis}")
            for item, count in counts.items():
                print(f"  {item:28}{count:>12,}  {count * 4 / 2**20:8.2f} MiB")
        return
    rates = measure_loading(PoseDataModule(args.dataset, args.root, args.scene))
    for name, figures in (("decode-once cache", rates.cached), ("decode every epoch", rates.decoded)):
        print(f"{name:20}{median(figures):8.0f} images/s on one core  ({min(figures):.0f} to {max(figures):.0f})")
    print(f"ratio {rates.ratio:.1f}   {provenance.device_name()}, commit {provenance.commit()}")


if __name__ == "__main__":
    main()
