"""Measure: tools/benchmark.py PART, where PART is one of those that --help lists; each has a --help of its own."""

import argparse
from pathlib import Path

from mambaloc import benchmark, list_models, provenance
from mambaloc.console import exits_cleanly, quieten, thread_count
from mambaloc.data import PoseDataModule
from mambaloc.errors import InputError
from mambaloc.models.registry import model_class
from mambaloc.sweep import Store, print_plan, read_matrix, run_matrix, write_report
from mambaloc.zoo.bundles import load_with_data


@exits_cleanly
def main() -> None:
    """Measure and print."""
    quieten()
    args = _parser().parse_args()
    args.call(args)


def _sizes(args: argparse.Namespace) -> None:
    benchmark.print_sizes(benchmark.size_table())


def _latency(args: argparse.Namespace) -> None:
    systems = [model_class(name).registry_name for name in args.systems or list_models()]
    found = benchmark.measure_latency(systems, args.image_size, (1, 8), args.repetitions, args.device)
    benchmark.print_latencies(found, args.image_size, _machine(0 if args.device == "cuda" else None))


def _loading(args: argparse.Namespace) -> None:
    data = PoseDataModule(args.dataset, args.root, args.scene)
    benchmark.print_loading(benchmark.measure_loading(data), _machine())


def _speed(args: argparse.Namespace) -> None:
    if args.out and not args.out.parent.is_dir():
        raise InputError(f"{args.out}: there is no folder {args.out.parent}; make it first")
    setting = _setting(args)
    cuda = setting.device.index if setting.device.type == "cuda" else None
    counts = {"steps": args.steps, "repetitions": args.repetitions, "workers": args.workers}
    report = benchmark.measure_all(setting, args.batches, args.frames, **counts, sought_m=args.reach)
    benchmark.print_report(report, _machine(cuda))
    if args.out:
        benchmark.write_report(report, args.out, _machine(cuda))


def _cpu(args: argparse.Namespace) -> None:
    found = benchmark.measure_cpu_settings(_setting(args), args.threads, args.steps, args.repetitions)
    benchmark.print_cpu_settings(found, args.threads, f"{args.system}, medians; {_machine()}")


def _setting(args: argparse.Namespace) -> benchmark.Setting:
    scene = {"dataset": args.dataset, "root": args.root, "scene": args.scene, "validation": "block"}
    setting = benchmark.Setting(model_class(args.system).registry_name, data=scene)
    for overlay in args.overlay:
        setting = setting.with_overlay(overlay)
    return setting


def _scenes(args: argparse.Namespace) -> None:
    found = benchmark.measure_scenes(args.dataset, args.root, args.scenes, args.short_side)
    benchmark.print_scenes(found, _machine())


def _deployment(args: argparse.Namespace) -> None:
    systems = {source: load_with_data(source) for source in args.sources}
    found = benchmark.measure_deployment(systems, args.threads, args.repetitions)
    benchmark.print_deployments(found, args.threads, _machine())


def _uncertainty(args: argparse.Namespace) -> None:
    systems = {checkpoint: load_with_data(checkpoint) for checkpoint in args.checkpoints}
    found = benchmark.measure_certainty(systems, args.elsewhere)
    benchmark.print_certainty(found, _machine())
    benchmark.write_certainty(found, args.out, _machine())
    print(f"{args.out}: uncertainty.json, uncertainty.png")


def _soak(args: argparse.Namespace) -> None:
    samples = benchmark.measure_soak(args.recipes, args.steps, args.out)
    benchmark.print_soak(samples, _machine())
    benchmark.draw_soak(samples, args.out / "soak.png", f"{args.recipes[0].stem}, {args.steps} steps")
    print(f"{args.out}: soak.png, samples.jsonl, train.log, run/")


def _run(args: argparse.Namespace) -> None:
    matrix, out = read_matrix(args.matrix), args.out or Path("runs/sweeps", args.matrix.stem)
    if args.dry_run:
        print_plan(matrix, Store.ended(out))
        return
    ended = run_matrix(matrix, out, args.address, args.retry_failed)
    print(f"{out}: {ended['done']} cells done, {ended['failed']} failed, {ended['found']} of them from before")


def _report(args: argparse.Namespace) -> None:
    out = args.out or args.results / "report"
    rows, failed = write_report(args.results, out, args.compare, args.epoch, args.reach)
    print(f"{out}: report.html, report.md, tables/, plots/; {len(rows)} rows, {len(failed)} cells failed")


def _machine(cuda: int | None = None) -> str:
    return f"{provenance.device_name(cuda)}, commit {provenance.commit()}"


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__)
    parts = parser.add_subparsers(required=True)
    part = parts.add_parser("sizes", help="parameters of every system beside the paper's")
    part.set_defaults(call=_sizes)
    part = parts.add_parser("latency", help="forward and training-step times with GIS, as ratios to without")
    part.add_argument("systems", nargs="*", help="names; all of them unless given")
    part.add_argument("--image-size", type=int, default=224)
    part.add_argument("--repetitions", type=int, default=20)
    part.add_argument("--device", default="cpu", help="cpu or cuda")
    part.set_defaults(call=_latency)
    part = parts.add_parser("loading", help="images per second from the cache and decoding every epoch")
    for name, default in (("--dataset", "embedded"), ("--root", None), ("--scene", "heads")):
        part.add_argument(name, default=default)
    part.set_defaults(call=_loading)
    part = parts.add_parser("speed", help="where training time goes, beside the loop of published research code")
    _add_setting(part)
    part.add_argument("--batches", type=int, nargs="*", default=[16, 32], help="other numbers of images a step")
    part.add_argument("--frames", type=int, nargs="*", default=[], help="numbers of frames to train an epoch on")
    part.add_argument("--steps", type=int, default=4, help="of a repetition")
    part.add_argument("--repetitions", type=int, default=5)
    part.add_argument("--workers", type=int, default=2, help="loader processes of the reference")
    part.add_argument("--reach", type=float, metavar="METRES", help="train a process until then, and to the end")
    part.add_argument("--out", type=Path, help="a .json file for every figure")
    part.set_defaults(call=_speed)
    part = parts.add_parser("cpu", help="what ONNX Runtime's options and a training process's settings are worth")
    _add_setting(part)
    part.add_argument("--threads", type=thread_count, default=2, help="of ONNX Runtime")
    part.add_argument("--steps", type=int, default=8, help="that are timed, of each process")
    part.add_argument("--repetitions", type=int, default=5, help="processes a setting")
    part.set_defaults(call=_cpu)
    part = parts.add_parser("scenes", help="what scenes cost to load whole: seconds, memory, disk")
    part.add_argument("root", type=Path, help="folder that holds them")
    part.add_argument("scenes", nargs="*", help="names; every official one that is there unless given")
    part.add_argument("--dataset", default="7scenes")
    part.add_argument("--short-side", type=int, default=256, help="what images are resized to, in pixels")
    part.set_defaults(call=_scenes)
    part = parts.add_parser("deployment", help="size, latency, errors of trained systems in every precision")
    part.add_argument("sources", nargs="+", help="checkpoints, zoo names; the first is what others are compared with")
    part.add_argument("--threads", type=thread_count, default=2)
    part.add_argument("--repetitions", type=int, default=50)
    part.set_defaults(call=_deployment)
    part = parts.add_parser("uncertainty", help="how sure poses are, by several ways of telling; coverage, rejection")
    part.add_argument("checkpoints", nargs="+", help="of one scene; several are also taken for an ensemble")
    part.add_argument("--elsewhere", type=Path, help="folder of pictures of another place")
    part.add_argument("--out", type=Path, default=Path("runs/uncertainty"), help="folder of the plot and the figures")
    part.set_defaults(call=_uncertainty)
    part = parts.add_parser("soak", help="memory, open files and threads over a long training")
    part.add_argument("recipes", type=Path, nargs="+", help="a recipe, and overlays")
    part.add_argument("--steps", type=int, default=10_000)
    part.add_argument("--out", type=Path, default=Path("runs/soak"), help="folder that is not there yet")
    part.set_defaults(call=_soak)
    part = parts.add_parser("run", help="train and evaluate a matrix of recipes, what ended before left alone")
    part.add_argument("matrix", type=Path, help="as recipes/sweeps/ holds them")
    part.add_argument("--out", type=Path, help="folder of results.sqlite and runs/; runs/sweeps/NAME unless given")
    part.add_argument("--address", help="of a Ray cluster, whose machines all see --out")
    part.add_argument("--retry-failed", action="store_true", help="run cells again that failed")
    part.add_argument("--dry-run", action="store_true", help="list the cells and what they may take")
    part.set_defaults(call=_run)
    part = parts.add_parser("report", help="what a matrix's results come to, beside the paper's tables")
    part.add_argument("results", type=Path, help="the folder that run wrote to")
    part.add_argument("--compare", nargs=3, action="append", default=[], metavar=("AXIS", "BEFORE", "AFTER"))
    part.add_argument("--epoch", default="last", choices=("last", "best"))
    part.add_argument("--reach", type=float, metavar="METRES", help="error whose training seconds are told")
    part.add_argument("--out", type=Path, help="folder to write; RESULTS/report unless given")
    part.set_defaults(call=_report)
    return parser


def _add_setting(part: argparse.ArgumentParser) -> None:
    part.add_argument("system", nargs="?", default="mambaloc")
    part.add_argument("--overlay", type=Path, action="append", default=[], help="as recipes/overlays/ holds them")
    for name, default in (("--dataset", "embedded"), ("--root", None), ("--scene", "heads")):
        part.add_argument(name, default=default)


if __name__ == "__main__":
    main()
