"""Measurements of the library itself: each a ratio taken in one run."""

from mambaloc.benchmark.cpu_settings import SettingTimes, measure_cpu_settings, print_cpu_settings
from mambaloc.benchmark.deployment import Deployment, measure_deployment
from mambaloc.benchmark.latency import Latency, forward_flops, measure_latency
from mambaloc.benchmark.loading import LoadingRates, measure_loading
from mambaloc.benchmark.report import print_deployments, print_latencies, print_loading, print_scenes, print_sizes
from mambaloc.benchmark.scenes import SceneCost, measure_scenes
from mambaloc.benchmark.sizes import Size, size_of, size_table
from mambaloc.benchmark.soak import Sample, draw_soak, measure_soak, print_soak
from mambaloc.benchmark.speed import Setting
from mambaloc.benchmark.speed_report import SpeedReport, measure_all, print_report, write_report
from mambaloc.benchmark.uncertainty import Certainty, measure_certainty
from mambaloc.benchmark.uncertainty_report import print_certainty, write_certainty

__all__ = [
    "Certainty",
    "Deployment",
    "Latency",
    "LoadingRates",
    "Sample",
    "SceneCost",
    "Setting",
    "SettingTimes",
    "Size",
    "SpeedReport",
    "draw_soak",
    "forward_flops",
    "measure_all",
    "measure_certainty",
    "measure_cpu_settings",
    "measure_deployment",
    "measure_latency",
    "measure_loading",
    "measure_scenes",
    "measure_soak",
    "print_certainty",
    "print_cpu_settings",
    "print_deployments",
    "print_latencies",
    "print_loading",
    "print_report",
    "print_scenes",
    "print_sizes",
    "print_soak",
    "size_of",
    "size_table",
    "write_certainty",
    "write_report",
]
