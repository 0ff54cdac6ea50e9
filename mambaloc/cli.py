"""The command line: recipes in, LightningCLI inside, a run's folder out."""

from __future__ import annotations

import inspect
import os
import sys
import time
from datetime import datetime
from pathlib import Path
from pkgutil import resolve_name
from typing import Any

import lightning as L
import torch
from jsonargparse import Namespace, class_from_function
from lightning.pytorch.callbacks import ModelCheckpoint
from lightning.pytorch.cli import LightningArgumentParser, LightningCLI, SaveConfigCallback
from lightning.pytorch.loggers import CSVLogger, Logger, TensorBoardLogger
from lightning.pytorch.plugins.environments import SLURMEnvironment

from mambaloc.callbacks import (
    AtomicCheckpointIO,
    EarlyStopping,
    MapBuild,
    MovedRun,
    OnnxExport,
    PoseProgressBar,
    TimeBudget,
    TrajectoryPlot,
    ViewRefresh,
    ViewSheet,
    WallClock,
)
from mambaloc.console import configure_logging, exit_on_input_error
from mambaloc.data import MultiSceneDataModule, PoseDataModule, build_data
from mambaloc.distillation import LitDistillation
from mambaloc.errors import InputError
from mambaloc.evaluation import (
    evaluate_checkpoint,
    evaluate_scenes,
    measure_map_of_run,
    print_scenes,
    print_table,
)
from mambaloc.evaluation.with_map import RUN_MAP
from mambaloc.files import read_yaml, writing
from mambaloc.models import Checkpoint, LitPoseRegressor
from mambaloc.recipes import recipe_path
from mambaloc.refusals import OneLineErrorParser, report_refusals

_RUN_DIR = "MAMBALOC_RUN_DIR"
_SUBCOMMANDS = ("fit", "validate", "test", "predict")


class SaveRecipe(SaveConfigCallback):
    """Keep the resolved recipe in the run's folder: it trains the same run again."""

    def save_config(self, trainer: L.Trainer, pl_module: L.LightningModule, stage: str) -> None:
        """Write ``config.yaml``; what a resumed run was given goes to ``config_resumed.yaml``."""
        name = "config_resumed.yaml" if self.config.get("ckpt_path") else "config.yaml"
        path = Path(trainer.default_root_dir, name)
        path.parent.mkdir(parents=True, exist_ok=True)
        self.parser.save(self.config, path, skip_unset=False, overwrite=True, multifile=False)


class RecipeCLI(LightningCLI):
    """LightningCLI whose runs each get a folder, and end with the test errors of the best and the last epoch.

    Args:
        began_s: reading of ``time.monotonic()`` from which a time budget counts; now unless given.
    """

    def __init__(self, *args: Any, began_s: float | None = None, **kwargs: Any) -> None:
        self.began_s = time.monotonic() if began_s is None else began_s
        super().__init__(*args, **kwargs)

    def add_arguments_to_parser(self, parser: LightningArgumentParser) -> None:
        """Give every run its callbacks, each a section of the recipe."""
        for name, callback in {
            "progress_bar": PoseProgressBar,
            "early_stopping": EarlyStopping,
            "wall_clock": WallClock,
            "time_budget": TimeBudget,
            "map": MapBuild,
            "onnx_export": OnnxExport,
            "trajectory_plot": TrajectoryPlot,
            "view_sheet": ViewSheet,
            "view_refresh": ViewRefresh,
            "best_checkpoint": ModelCheckpoint,
            "last_checkpoint": ModelCheckpoint,  # a callback of its own: `save_last` follows the best one only
        }.items():
            parser.add_lightning_class_args(callback, name)
        for name in ("best", "last"):
            parser.set_defaults(
                {
                    f"{name}_checkpoint.filename": name,
                    # The best is chosen after a validation: epochs without one have no value, or that of other weights.
                    f"{name}_checkpoint.save_on_train_epoch_end": name == "last",
                    f"{name}_checkpoint.enable_version_counter": False,
                }
            )
        parser.set_defaults({"best_checkpoint.monitor": "val/loss"})
        of_a_scene = inspect.signature(PoseDataModule).parameters.values()  # build_data hands them on without defaults
        parser.set_defaults({f"data.{each.name}": each.default for each in of_a_scene})
        parser.add_argument(
            "--retrieval",
            type=bool,
            default=False,
            help="also measure image retrieval with the backbone's initial weights",
        )
        for shared in ("image_size", "scenes"):
            parser.link_arguments(f"data.{shared}", f"model.init_args.{shared}")

    def parse_arguments(self, parser: LightningArgumentParser, args: Any) -> None:
        """Refuse a file that is not a checkpoint before anything reads it."""
        super().parse_arguments(parser, args)
        if checkpoint := self.config[self.config["subcommand"]].get("ckpt_path"):
            Checkpoint.read(checkpoint)

    def _parse_ckpt_path(self) -> None:
        """Resume what the command says: Lightning would put the checkpoint's hyperparameters over the recipe's."""

    def before_instantiate_classes(self) -> None:
        """Without validation no epoch is better than another; what only fails at the end is refused here."""
        config = self.config[self.subcommand]
        _refuse_null("data", config.data, PoseDataModule)
        _refuse_null("model", config.model.init_args, resolve_name(config.model.class_path))
        if config.get("retrieval") and not config.model.init_args.get("backbone_weights"):
            raise InputError(
                "retrieval: needs a pretrained backbone. Set model.backbone_weights, or retrieval to false."
            )
        if config.trainer.enable_checkpointing is False:
            raise InputError(
                "trainer.enable_checkpointing false: a run ends by evaluating its checkpoints. Leave it out; "
                "best_checkpoint.save_top_k 0 keeps only the last one."
            )
        if str(config.trainer.precision) in ("16-true", "bf16-true"):
            raise InputError(
                f"trainer.precision {config.trainer.precision}: images and poses are float32, so weights must be. "
                f"Give {str(config.trainer.precision).replace('true', 'mixed')}."
            )
        if config.data.scenes and config.map.enabled:
            raise InputError("map.enabled true: a map is of one scene, and data.scenes names several. Set it to false.")
        if config.data.validation == "none":
            config.best_checkpoint.save_top_k = 0

    def instantiate_trainer(self, **kwargs: Any) -> L.Trainer:
        """Log into the run's folder and where the recipe says; write checkpoints whole unless it names a plugin."""
        config = self.config[self.subcommand]
        run_dir = str(run_directory(config))
        kwargs = {"default_root_dir": run_dir, **kwargs}
        if config.trainer.logger is not False and not config.trainer.fast_dev_run:
            named = self.config_init[self.subcommand].trainer.logger
            others = named if isinstance(named, list) else [named] if isinstance(named, Logger) else []
            # TensorBoard first: checkpoints follow its place. A resumed run writes a CSV of its own beside the first.
            own = [TensorBoardLogger(run_dir, name="", version=""), CSVLogger(run_dir, name="metrics")]
            kwargs["logger"] = [*own, *others]
        trainer = super().instantiate_trainer(**kwargs)
        if not config.trainer.plugins:
            trainer.strategy.checkpoint_io = AtomicCheckpointIO()
        return trainer

    def _instantiate_trainer(self, config: dict[str, Any], callbacks: list[L.Callback]) -> L.Trainer:
        """Leave the progress bar out where the recipe switches it off, which Lightning refuses; and find moved runs."""
        if config.get("enable_progress_bar") is False:
            callbacks = [each for each in callbacks if not isinstance(each, PoseProgressBar)]
        return super()._instantiate_trainer(config, [MovedRun(), *callbacks])

    def before_fit(self) -> None:
        """Let a time budget begin where the command began."""
        for callback in self.trainer.callbacks:  # type: ignore[attr-defined]
            if isinstance(callback, TimeBudget):
                callback.began_s = self.began_s

    def fit(self, model: L.LightningModule, **kwargs: Any) -> None:
        """Train; an interrupted run says how to go on.

        Raises:
            InputError: where the run's folder cannot be written.
        """
        run_dir = Path(self.trainer.default_root_dir)
        try:
            with writing(run_dir, "free some space, or choose another --trainer.default_root_dir"):
                self.trainer.fit(model, **{**kwargs, "weights_only": True})
        except SystemExit:  # Lightning's answer to Ctrl-C
            last = run_dir / "checkpoints" / "last.ckpt"
            if last.is_file():
                print(f"interrupted: resume with the same command and --ckpt_path {last}", file=sys.stderr)
            raise

    def after_fit(self) -> None:
        """Measure the best and the last epoch on the test split, in one process."""
        if torch.distributed.is_initialized():
            torch.distributed.barrier()
            torch.distributed.destroy_process_group()  # else the one would wait for all
        if self.trainer.fast_dev_run or not self.trainer.is_global_zero:  # type: ignore[attr-defined]
            return
        run_dir = Path(self.trainer.default_root_dir)
        paths = [run_dir / "checkpoints" / f"{name}.ckpt" for name in ("best", "last")]
        found = [Checkpoint.read(path) for path in paths if path.is_file()]
        if not found:
            return
        retrieval = self.config[self.subcommand].retrieval
        figure = f"evaluation/{found[0].path.stem}/trajectory.png"
        beside = None
        if isinstance(data := found[0].data(), MultiSceneDataModule):
            figure = str(Path(figure).parent)
            for each in found:
                print_scenes(
                    evaluate_scenes(each, run_dir / "evaluation" / each.path.stem, data, with_retrieval=retrieval)
                )
        else:
            beside = measure_map_of_run(run_dir, data)
            results = [
                evaluate_checkpoint(
                    each, run_dir / "evaluation" / each.path.stem, with_retrieval=retrieval, beside=beside
                )
                for each in found
            ]
            print_table(results)
        exported = [name for name in ("model.onnx", "bundle") if (run_dir / name).exists()]
        files = [figure, *exported, "checkpoints", "config.yaml"]
        print(f"wrote {run_dir}: {', '.join([str(RUN_MAP), *files] if beside else files)}")


def run_directory(config: Namespace) -> Path:
    """Name a run's folder: a resumed run's own, else ``trainer.default_root_dir``, else ``runs/RECIPE/TIME``.

    The processes that Lightning starts for a distributed run get it from the first one; those that SLURM starts name it
    after their job and its step.
    """
    if os.environ.get("LOCAL_RANK", "0") != "0" and _RUN_DIR in os.environ:
        return Path(os.environ[_RUN_DIR])
    given = Path(config.get("ckpt_path") or "")
    paths = (given, given.absolute(), given.resolve())  # it may be given from its own folder, or by a link
    checkpoint = next((path for path in paths if path.parent.name == "checkpoints"), None)
    if checkpoint:
        run_dir = checkpoint.parent.parent
    elif config.trainer.default_root_dir:
        run_dir = Path(config.trainer.default_root_dir)
    else:
        name = "+".join(Path(str(recipe)).stem for recipe in config.config or []) or "run"
        if SLURMEnvironment.detect():  # processes that share a step of a job share a run
            stamp = f"job-{os.environ['SLURM_JOB_ID']}.{os.environ.get('SLURM_STEP_ID', 0)}"
        else:
            stamp = datetime.now().strftime("%Y%m%d-%H%M%S")
        run_dir = Path("runs", name, stamp)
    os.environ[_RUN_DIR] = str(run_dir)
    return run_dir


def _refuse_null(section: str, given: Namespace, cls: type) -> None:
    """Refuse ``null`` where a parameter has another default: jsonargparse takes it whatever the annotation says."""
    signatures = [inspect.signature(base.__init__).parameters.values() for base in reversed(cls.__mro__)]  # type: ignore[misc]
    defaults = {each.name: each.default for signature in signatures for each in signature}
    for name, value in given.items():
        if value is None and defaults.get(name) not in (None, inspect.Parameter.empty):
            raise InputError(f"{section}.{name} null: needs a value. Leave it out for the default, {defaults[name]}.")


def recipe_arguments(argv: list[str]) -> list[str]:
    """Turn ``[SUBCOMMAND] RECIPE [OVERLAY ...] [--key value ...]`` into LightningCLI's own arguments.

    Recipes are files, or names of those that come with the package.

    Raises:
        InputError: where no recipe comes first, or one does not exist.
    """
    subcommand, words = ("fit", argv) if not argv or argv[0] not in _SUBCOMMANDS else (argv[0], argv[1:])
    if words and words[0] in ("-h", "--help"):
        return [subcommand, "--help"]
    recipes = []
    while words and not words[0].startswith("-"):
        recipe = recipe_path(words[0])
        read_yaml(recipe, "see recipes/", "correct it")  # before a parser that expands whatever stands there
        recipes += ["--config", str(recipe)]
        words = words[1:]
    if not recipes:
        given = f"before {argv[0]}" if argv else ""
        raise InputError(f"a recipe comes first{', ' + given if given else ''}: train RECIPE [--key value ...]")
    stray = next((word for word in words if word.endswith((".yaml", ".yml")) and Path(word).is_file()), None)
    if stray and words[words.index(stray) - 1 if words.index(stray) else 0] != "--config":
        raise InputError(f"{stray}: recipes and overlays come before the options; move it to the front")
    return [subcommand, *recipes, *words]


@exit_on_input_error
def main(argv: list[str] | None = None, began_s: float | None = None) -> RecipeCLI:
    """Run ``mambaloc train``.

    Args:
        argv: what follows the command's name; that of this process unless given.
        began_s: as :class:`RecipeCLI` takes it.
    """
    configure_logging()
    argv = sys.argv[1:] if argv is None else argv
    with report_refusals(argv):
        return RecipeCLI(
            LitPoseRegressor,
            class_from_function(build_data, L.LightningDataModule),
            began_s=began_s,
            parser_class=OneLineErrorParser,
            subclass_mode_model=True,
            auto_configure_optimizers=False,
            args=recipe_arguments(argv),
            seed_everything_default=0,
            save_config_callback=SaveRecipe,
            save_config_kwargs={"save_to_log_dir": False},
            trainer_defaults={
                "max_epochs": 600,  # the paper's cap
                "num_sanity_val_steps": 0,
                "log_every_n_steps": 1,
                "enable_model_summary": False,
            },
            parser_kwargs={"parser_mode": "yaml"},
        )


__all__ = ["LitDistillation", "RecipeCLI", "main", "recipe_arguments"]

if __name__ == "__main__":
    main()
