"""The command ``mambaloc``, one file for each of its subcommands; ``tools/`` has a script for each, too."""

from __future__ import annotations

import sys
from importlib import import_module

from mambaloc import __version__
from mambaloc.errors import suggestion

_MODULES = {
    "train": ("train", "train a recipe"),
    "evaluate": ("evaluate", "measure a checkpoint on test frames"),
    "import": ("import_scene", "make a scene of a capture"),
    "export-scene": ("export_scene", "write an imported scene as kapture"),
    "map": ("map", "build a sparse map, or change one"),
    "localize": ("localize", "localize images, a video or a camera"),
    "export": ("export", "write a bundle for apps"),
    "verify": ("verify_bundle", "replay a bundle's frames through its models"),
    "demo": ("demo", "localize in a browser"),
    "serve": ("serve", "localize over HTTP"),
    "visualize": ("visualize", "draw figures of a trained system"),
    "download": ("download", "get a public dataset from its official address"),
    "render": ("render_scene", "render a scene"),
    "sweep": ("sweep", "train many recipes, and report"),
    "benchmark": ("benchmark", "measure speed, latency and size"),
    "publish": ("publish", "release a model"),
}
_TAKES_BUNDLES = ("localize", "demo", "serve")  # only the released model that they use by default needs PyTorch
_OF_TRAINING = {
    "huggingface_hub", "jsonargparse", "lightning", "onnx", "onnxscript", "tensorboard", "timm", "torch",
    "torchmetrics",
}  # fmt: skip
"""Modules of the packages of the extra ``train``."""
_USAGE = """usage: mambaloc COMMAND [...]

{}

mambaloc COMMAND --help lists a command's options.
mambaloc --version prints the version."""


def main() -> None:
    """Run the subcommand that the command line names. Nothing heavy is imported before it is known."""
    name, words = (sys.argv[1], sys.argv[2:]) if len(sys.argv) > 1 else ("--help", [])
    if name in ("-h", "--help"):
        print(_USAGE.format("\n".join(f"  {each:<12} {does}" for each, (_, does) in _MODULES.items())))
        return
    if name == "--version":
        print(f"mambaloc {__version__}")
        return
    if name not in _MODULES:
        print(f"error: mambaloc {name}: no such command. {suggestion(name, _MODULES)}", file=sys.stderr)
        raise SystemExit(2)
    if name == "train":  # Lightning starts the process again for each further device, by the words in sys.argv
        run(name, words)
    else:
        sys.argv = [f"mambaloc {name}", *words]
        run(name)


def run(name: str, words: list[str] | None = None) -> None:
    """Run a subcommand; print one line if it needs PyTorch, which is missing.

    Args:
        name: of the subcommand.
        words: what follows it on the command line, for ``train``; those of ``sys.argv`` unless given.
    """
    try:
        subcommand = import_module(f"{__name__}.{_MODULES[name][0]}")
        if words is None:
            subcommand.main()
        else:
            subcommand.main(words)
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] not in _OF_TRAINING:
            raise
        needy = f"mambaloc {name} without a bundle" if name in _TAKES_BUNDLES else f"mambaloc {name}"
        remedy = "Run: pip install 'mambaloc[train]'"
        print(f"error: {needy} needs PyTorch, which is not installed. {remedy}", file=sys.stderr)
        raise SystemExit(2) from None
