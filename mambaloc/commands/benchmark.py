"""Measure: mambaloc benchmark PART, where PART is one of those that --help lists; each has a --help of its own."""

import argparse
from pathlib import Path

from mambaloc import benchmark, list_models, provenance
from mambaloc.console import OptionParser, configure_logging, exit_on_input_error, thread_count, whole_number
from mambaloc.errors import InputError
from mambaloc.models.registry import model_class
from mambaloc.zoo.bundles import load_with_scene


@exit_on_input_error
def main() -> None:
    """Measure and print."""
    configure_logging()
    parser = OptionParser(description=__doc__)
    parts = parser.add_subparsers(required=True)
    part = parts.add_parser("sizes", help="parameter counts of every system, compared with the paper's")
    part.set_defaults(call=lambda args: benchmark.print_sizes(benchmark.size_table()))
    part = parts.add_parser("latency", help="forward and training-step times with GIS, as ratios to without")
    part.add_argument("systems", nargs="*", help="names of systems (default: all)")
    part.add_argument("--image-size", type=whole_number(32), default=224)
    part.add_argument("--repetitions", type=whole_number(2), default=20)
    part.add_argument("--device", default="cpu", help="cpu or cuda")
    part.set_defaults(call=_latency)
    part = parts.add_parser("deployment", help="size, latency, errors of trained systems in every precision")
    part.add_argument("sources", nargs="+", help="checkpoints or released models, compared with the first")
    part.add_argument("--threads", type=thread_count, default=2)
    part.add_argument("--repetitions", type=whole_number(2), default=50)
    part.set_defaults(call=_deployment)
    part = parts.add_parser("speed", help="seconds and memory of training steps, compared with published programs")
    part.add_argument("system", nargs="?", default="mambaloc")
    part.add_argument(
        "--overlay", type=Path, action="append", default=[], help="an overlay such as those in recipes/overlays/"
    )
    for name, default in (("--dataset", "embedded"), ("--root", None), ("--scene", "heads")):
        part.add_argument(name, default=default)
    part.add_argument(
        "--batch", type=whole_number(1), nargs="*", default=[], help="images per step (default: as published)"
    )
    part.add_argument("--frames", type=whole_number(2), nargs="*", default=[], help="of an epoch")
    part.add_argument("--steps", type=whole_number(1), default=3, help="of a turn")
    part.add_argument("--turns", type=whole_number(1), default=3, help="of each program, a process each")
    part.add_argument("--reach", type=float, metavar="METRES", help="train a process until then, and to the end")
    part.add_argument("--out", type=Path, help="a .json file for every figure")
    part.set_defaults(call=_speed)
    args = parser.parse_args()
    args.call(args)


def _latency(args: argparse.Namespace) -> None:
    systems = [model_class(name).registry_name for name in args.systems or list_models()]
    found = benchmark.measure_latency(systems, args.image_size, (1, 8), args.repetitions, args.device)
    machine = provenance.machine(0 if args.device == "cuda" else None)
    benchmark.print_latencies(found, args.image_size, machine)


def _deployment(args: argparse.Namespace) -> None:
    systems = {source: load_with_scene(source) for source in args.sources}
    found = benchmark.measure_deployment(systems, args.threads, args.repetitions)
    benchmark.print_deployments(found, args.threads, provenance.machine())


def _speed(args: argparse.Namespace) -> None:
    if args.out and not args.out.parent.is_dir():
        raise InputError(f"{args.out}: the folder {args.out.parent} does not exist; make it first")
    scene = {"dataset": args.dataset, "root": args.root, "scene": args.scene, "validation": "block"}
    system = model_class(args.system).registry_name
    setting = benchmark.BenchmarkConfig(system, data={**benchmark.PUBLISHED_DATA.get(system, {}), **scene})
    for overlay in args.overlay:
        setting = setting.with_overlay(overlay)
    report = benchmark.measure_all(setting, args.batch, args.frames, args.steps, args.turns, args.reach)
    machine = provenance.machine(setting.device.index if setting.device.type == "cuda" else None)
    benchmark.print_report(report, machine)
    if args.out:
        benchmark.write_report(report, args.out, machine)
