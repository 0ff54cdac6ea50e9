"""Measurements of the library itself: each a ratio taken in one run."""

from mambaloc.benchmark.deployment import Deployment, measure_deployment
from mambaloc.benchmark.latency import Latency, forward_flops, measure_latency
from mambaloc.benchmark.reference import PUBLISHED_DATA
from mambaloc.benchmark.report import print_deployments, print_latencies, print_sizes
from mambaloc.benchmark.setting import BenchmarkConfig
from mambaloc.benchmark.sizes import Size, size_of, size_table
from mambaloc.benchmark.speed_report import SpeedReport, measure_all, print_report, write_report
from mambaloc.renamed import renamed

__all__ = [
    "PUBLISHED_DATA",
    "BenchmarkConfig",
    "Deployment",
    "Latency",
    "Size",
    "SpeedReport",
    "forward_flops",
    "measure_all",
    "measure_deployment",
    "measure_latency",
    "print_deployments",
    "print_latencies",
    "print_report",
    "print_sizes",
    "size_of",
    "size_table",
    "write_report",
]

__getattr__ = renamed(__name__, {"Setting": "BenchmarkConfig"})
