"""The command line: recipes in, LightningCLI inside, a run's folder out."""

from __future__ import annotations

import logging
import os
import sys
from datetime import datetime
from pathlib import Path
from typing import Any

import lightning as L
from lightning.pytorch.callbacks import ModelCheckpoint
from lightning.pytorch.cli import LightningArgumentParser, LightningCLI
from lightning.pytorch.loggers import CSVLogger, TensorBoardLogger

from mambaloc.callbacks import EarlyStopping, OnnxExport, PoseProgressBar, TrajectoryPlot, WallClock
from mambaloc.data import PoseDataModule
from mambaloc.errors import InputError, exits_cleanly
from mambaloc.evaluation import evaluate_checkpoint, print_table
from mambaloc.models import LitPoseRegressor

_RUN_DIR = "MAMBALOC_RUN_DIR"
_SUBCOMMANDS = ("fit", "validate", "test", "predict")


class RecipeCLI(LightningCLI):
    """LightningCLI whose runs each get a folder, and end with the test errors of the best and the last epoch."""

    def add_arguments_to_parser(self, parser: LightningArgumentParser) -> None:
        """Give every run its callbacks, each a section of the recipe."""
        for name, callback in {
            "progress_bar": PoseProgressBar,
            "checkpoint": ModelCheckpoint,
            "early_stopping": EarlyStopping,
            "wall_clock": WallClock,
            "onnx_export": OnnxExport,
            "trajectory_plot": TrajectoryPlot,
        }.items():
            parser.add_lightning_class_args(callback, name)
        parser.set_defaults(
            {
                "checkpoint.filename": "best",
                "checkpoint.monitor": "val/loss",
                "checkpoint.save_last": True,
                "checkpoint.save_on_train_epoch_end": True,
                "checkpoint.enable_version_counter": False,
            }
        )
        parser.link_arguments("data.image_size", "model.init_args.image_size")

    def before_instantiate_classes(self) -> None:
        """Without validation there is no best epoch: keep the last."""
        config = self.config[self.subcommand]
        if config.data.validation == "none":
            config.checkpoint.monitor = None

    def instantiate_trainer(self, **kwargs: Any) -> L.Trainer:
        """Log into the run's folder, unless the recipe names loggers of its own."""
        config = self.config[self.subcommand].trainer
        if config.logger in (None, True) and not config.fast_dev_run:
            run_dir = str(run_directory(self.config[self.subcommand].config or []))
            loggers = (CSVLogger(run_dir, name="", version=""), TensorBoardLogger(run_dir, name="", version=""))
            kwargs = {"default_root_dir": run_dir, "logger": list(loggers), **kwargs}
        return super().instantiate_trainer(**kwargs)

    def after_fit(self) -> None:
        """Measure the best and the last epoch on the test split."""
        checkpoints = Path(self.trainer.checkpoint_callback.dirpath or "")  # type: ignore[union-attr]
        if self.trainer.fast_dev_run or not self.trainer.is_global_zero:  # type: ignore[attr-defined]
            return
        run_dir = checkpoints.parent
        found = [p for p in (checkpoints / "best.ckpt", checkpoints / "last.ckpt") if p.is_file()]
        if results := [evaluate_checkpoint(p, run_dir / "evaluation" / p.stem) for p in found]:
            print_table(results)
            print(f"{run_dir}: model.onnx, evaluation/{found[0].stem}/trajectory.png, checkpoints, logs, config.yaml")


def run_directory(recipes: list[Any]) -> Path:
    """Name this run's folder, ``runs/RECIPE/TIME``; the processes of a distributed run agree on it."""
    if _RUN_DIR not in os.environ:
        name = "+".join(Path(str(recipe)).stem for recipe in recipes) or "run"
        os.environ[_RUN_DIR] = str(Path("runs", name, datetime.now().strftime("%Y%m%d-%H%M%S")))
    return Path(os.environ[_RUN_DIR])


def recipe_arguments(argv: list[str]) -> list[str]:
    """Turn ``[SUBCOMMAND] RECIPE.yaml [OVERLAY.yaml ...] [--key value ...]`` into LightningCLI's own arguments.

    Raises:
        InputError: where no recipe comes first, or one does not exist.
    """
    subcommand, words = ("fit", argv) if not argv or argv[0] not in _SUBCOMMANDS else (argv[0], argv[1:])
    if words and words[0] in ("-h", "--help"):
        return [subcommand, "--help"]
    recipes = []
    while words and words[0].endswith((".yaml", ".yml")):
        if not Path(words[0]).is_file():
            raise InputError(f"{words[0]}: no such recipe; see recipes/")
        recipes += ["--config", words[0]]
        words = words[1:]
    if not recipes:
        given = f"before {argv[0]}" if argv else ""
        raise InputError(f"a recipe comes first{', ' + given if given else ''}: train.py RECIPE.yaml [--key value ...]")
    stray = next((word for word in words if word.endswith((".yaml", ".yml")) and Path(word).is_file()), None)
    if stray and words[words.index(stray) - 1 if words.index(stray) else 0] != "--config":
        raise InputError(f"{stray}: recipes and overlays come before the options; move it to the front")
    return [subcommand, *recipes, *words]


@exits_cleanly
def main(argv: list[str] | None = None) -> RecipeCLI:
    """Run ``tools/train.py``."""
    logging.getLogger("lightning.pytorch.utilities.rank_zero").addFilter(
        lambda record: "litlogger" not in record.getMessage().lower() and "💡" not in record.getMessage()
    )
    return RecipeCLI(
        LitPoseRegressor,
        PoseDataModule,
        subclass_mode_model=True,
        args=recipe_arguments(sys.argv[1:] if argv is None else argv),
        seed_everything_default=0,
        trainer_defaults={
            "max_epochs": 600,  # the paper's cap
            "num_sanity_val_steps": 0,
            "log_every_n_steps": 1,
            "enable_model_summary": False,
        },
        parser_kwargs={"parser_mode": "yaml"},
    )


__all__ = ["RecipeCLI", "main", "recipe_arguments"]
