"""Measure the library: python tools/benchmark.py sizes | latency | deployment CHECKPOINT ... | loading."""

import argparse

from mambaloc import benchmark, list_models, provenance
from mambaloc.console import exits_cleanly, quieten, thread_count
from mambaloc.data import PoseDataModule
from mambaloc.models.registry import model_class
from mambaloc.zoo.bundles import load_with_data


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
    deployment = what.add_parser("deployment", help="size, latency, errors of trained systems in every precision")
    deployment.add_argument(
        "sources", nargs="+", help="checkpoints or zoo names; the first is what others are faster than"
    )
    deployment.add_argument("--threads", type=thread_count, default=2)
    deployment.add_argument("--repetitions", type=int, default=50)
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
    elif args.what == "deployment":
        found = benchmark.measure_deployment(
            {source: load_with_data(source) for source in args.sources}, args.threads, args.repetitions
        )
        benchmark.print_deployments(found, args.threads, machine)
    else:
        systems = [model_class(name).registry_name for name in args.systems or list_models()]
        found = benchmark.measure_latency(systems, args.image_size, (1, 8), args.repetitions, args.device)
        benchmark.print_latencies(found, args.image_size, machine)


if __name__ == "__main__":
    main()
