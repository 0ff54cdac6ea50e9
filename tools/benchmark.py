"""Measure the library: python tools/benchmark.py sizes | latency [SYSTEM ...] | loading [--scene NAME ...]."""

import argparse

from mambaloc import benchmark, list_models, provenance
from mambaloc.console import exits_cleanly, quieten
from mambaloc.data import PoseDataModule
from mambaloc.models.registry import model_class


@exits_cleanly
def main() -> None:
    """Measure and print."""
    quieten()
    parser = argparse.ArgumentParser(description=__doc__)
    what = parser.add_subparsers(dest="what", required=True)
    what.add_parser("sizes", help="parameters of every system beside the paper's")
    latency = what.add_parser("latency", help="forward and training-step times with GIS, as ratios to without")
    latency.add_argument("systems", nargs="*", help="names; all of them unless given")
    latency.add_argument("--image-size", type=int, default=224)
    latency.add_argument("--repetitions", type=int, default=20)
    latency.add_argument("--device", default="cpu", help="cpu or cuda")
    loading = what.add_parser("loading", help="images per second from the cache and decoding every epoch")
    for name, default in (("--dataset", "embedded"), ("--root", None), ("--scene", "heads")):
        loading.add_argument(name, default=default)
    args = parser.parse_args()
    cuda = 0 if getattr(args, "device", "cpu") == "cuda" else None
    machine = f"{provenance.device_name(cuda)}, commit {provenance.commit()}"
    if args.what == "sizes":
        benchmark.print_sizes(benchmark.size_table())
    elif args.what == "loading":
        benchmark.print_loading(benchmark.measure_loading(PoseDataModule(args.dataset, args.root, args.scene)), machine)
    else:
        systems = [model_class(name).registry_name for name in args.systems or list_models()]
        found = benchmark.measure_latency(systems, args.image_size, (1, 8), args.repetitions, args.device)
        benchmark.print_latencies(found, args.image_size, machine)


if __name__ == "__main__":
    main()
