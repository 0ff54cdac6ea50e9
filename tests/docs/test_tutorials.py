"""Pages that a reader follows from their first command to the last: each of these tests runs blocks of one page."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import torch
import yaml
from doc_blocks import README, ROOT, blocks, shell_commands


def test_gis_goes_into_anyones_model():
    (example,) = [block for block in blocks(README, "python") if "GlobalInformationSelector" in block.text]
    names: dict[str, object] = {}
    exec(example.text, names)
    model = names["model"]
    logits = model(torch.rand(2, 3, 64, 64))
    assert logits.shape == (2, 10)
    logits.sum().backward()
    selector = next(m for m in model.modules() if isinstance(m, names["GlobalInformationSelector"]))
    assert all(p.grad is not None for p in selector.parameters())


def test_a_system_of_another_package_trains_and_is_evaluated(tmp_path, den):
    """``docs/new_system.md``, as a reader follows it: a package with an entry point, a recipe, the command line."""
    page = ROOT / "docs/new_system.md"
    package = tmp_path / "package"
    package.mkdir()
    (package / "branchnet.py").write_text(blocks(page, "python")[0].text)
    about = package / "branchnet-1.0.dist-info"  # what pip writes of the page's pyproject.toml
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: branchnet\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text("[mambaloc.models]\nbranchnet = branchnet:LitBranchNet\n")
    assert 'branchnet = "branchnet:LitBranchNet"' in blocks(page, "toml")[0].text

    recipe = yaml.safe_load(blocks(page, "yaml")[0].text)
    recipe["model"]["init_args"] |= {"backbone": "test_efficientnet", "width": 16}
    recipe["data"] = {"dataset": "7scenes", "root": str(den), "scene": "den", "image_size": 64, "short_side": 72}
    recipe["trainer"] = {"max_epochs": 1, "default_root_dir": str(tmp_path / "run")}
    (tmp_path / "branchnet.yaml").write_text(yaml.safe_dump(recipe))

    words = [
        ["train", str(tmp_path / "branchnet.yaml"), "--onnx_export.enabled", "false"],
        ["evaluate", str(tmp_path / "run/checkpoints/last.ckpt"), "--out", str(tmp_path / "results")],
    ]
    program = (
        f"import sys; sys.path[:0] = [{str(package)!r}, {str(ROOT)!r}]\n"
        "import mambaloc, mambaloc.commands as commands; print(mambaloc.list_models('branch*'))\n"
        f"for words in {words!r}: sys.argv = ['mambaloc', *words]; commands.main()"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    assert done.stdout.startswith("['branchnet']")
    assert (tmp_path / "results/metrics.json").is_file()

    (tmp_path / "test_branchnet.py").write_text(blocks(page, "python")[1].text)
    words = ["-c", program.splitlines()[0] + "\nimport pytest; sys.exit(pytest.main(['-q', 'test_branchnet.py']))"]
    done = subprocess.run([sys.executable, *words], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout[-2000:]
    assert "3 passed" in done.stdout


def test_the_phone_app_refuses_and_takes_another_lens(workspace, mambaloc, capsys):
    """``docs/phone_app.md``: an image of another shape is refused in the page's words, and localized by its intrinsics.

    The page's frame is the last of the bundle, a part of the first one; here it has another size.
    """
    page = ROOT / "docs/phone_app.md"
    refused, taken = [next(shell_commands(b)) for b in blocks(page, "bash") if b.run_by and "another_lens" in b.run_by]
    frame = json.loads(Path("phone/contract.json").read_text())["frames"][-1]
    (fx, _, cx), (_, fy, cy), _ = frame["intrinsics"]
    assert frame["file"] == "frames/5.png"
    with pytest.raises(SystemExit) as ended:
        mambaloc(*refused[1:])
    assert ended.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    (printed,) = [b.text for b in blocks(page, "") if b.text.startswith("error: ")]
    words = printed.split(" of 280x240: ")[1].split(" 78 it ")[0]
    assert words in line
    assert line.endswith("give frames shaped as in training, or their intrinsics")
    assert taken[-2] == "--intrinsics"
    mambaloc(*taken[1:-1], f"{fx},{fy},{cx},{cy}")
    assert len(Path("poses.tum").read_text().splitlines()) == 2


def test_evo_measures_what_evaluate_does(workspace, mambaloc):
    """``docs/paper_table.md``: evo's medians are those of metrics.json. Guess: to four digits, of nine."""
    evo_ape = Path(sys.executable).with_name("evo_ape")
    if not evo_ape.is_file():
        pytest.skip("the page's other program; pip install evo")
    (block,) = [b for b in blocks(ROOT / "docs/paper_table.md", "bash") if "evo_ape" in b.text]
    mambaloc("evaluate", "RUN/checkpoints/last.ckpt", "--out", "measured")
    shutil.copyfile("measured/predictions.tum", "theirs.tum")
    medians = json.loads(Path("measured/metrics.json").read_text())["metrics"]
    expected = [medians[name] for name in ("position_error_m", "rotation_error_deg", "position_error_m")]
    for words, median in zip(shell_commands(block), expected, strict=True):
        home = {**os.environ, "HOME": str(workspace)}  # evo writes its settings there
        printed = subprocess.run([evo_ape, *words[1:]], env=home, capture_output=True, text=True, check=True).stdout
        figures = dict(line.split() for line in printed.splitlines() if len(line.split()) == 2)
        assert float(figures["median"]) == pytest.approx(median, rel=1e-4)
