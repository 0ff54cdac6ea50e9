"""What a bundle says to people: its card, its licence, and how an app uses it."""

from __future__ import annotations

from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

from mambaloc.data.datasets.registry import licence_of_weights
from mambaloc.runtime.contract import Contract
from mambaloc.runtime.maps import MAP_FILE, SparseMap
from mambaloc.runtime.undistortion import Undistortion

TARGETS = ("android", "ios", "react_native", "web", "pc")
"""Kinds of app that there is a page on integration for."""

_INTEGRATION = files("mambaloc.export") / "integration"
_MAP_LOCALIZER = "map_localiser.hpp"


def write_pages(
    folder: Path, contract: Contract, dataset: str, models: Sequence[str], target: str, sparse_map: SparseMap | None
) -> None:
    """Write ``README.md``, ``LICENSE.txt`` and ``INTEGRATION.md``; beside a map, its localizer in C++ for native apps.

    Args:
        folder: the bundle.
        contract: of its models.
        dataset: that they were trained on.
        models: their files.
        target: of ``TARGETS``.
        sparse_map: beside them, where there is one.
    """
    is_native = target != "web"
    page = (_INTEGRATION / f"{target}.md").read_text(encoding="utf-8")
    for name, text in (
        ("README.md", _card(contract, models, sparse_map, is_native)),
        ("LICENSE.txt", _licence(dataset)),
        ("INTEGRATION.md", f"{page}\n{_images(contract.undistortion)}"),
    ):
        (folder / name).write_text(text, encoding="utf-8")
    if sparse_map is not None and is_native:
        (folder / _MAP_LOCALIZER).write_bytes((_INTEGRATION / _MAP_LOCALIZER).read_bytes())


def _licence(dataset: str) -> str:
    return f"""Code and architecture: Apache-2.0.

The weights follow the terms of the frames that they were trained on, and so do frames/, trajectory.json and
map.safetensors, which hold some of those frames, their poses and their keypoints: {licence_of_weights(dataset)}
"""


def _card(contract: Contract, models: Sequence[str], sparse_map: SparseMap | None, is_native: bool) -> str:
    files = [f"- `{name}`" for name in models]
    if sparse_map is not None:
        points, frames = len(sparse_map), len(sparse_map.key_poses)
        files.append(f"- `{MAP_FILE}`: sparse map, {points} points of {frames} key frames, for poses to centimetres")
        files += [f"- `{_MAP_LOCALIZER}`: localizes in it, in C++"] if is_native else []
    listed = "\n".join(files)
    trained = "\n".join(
        f"- {name}: {_in_words(value)}" for name, value in contract.trained.items() if value is not None
    )
    return f"""# {contract.model} on {contract.scene}

Camera pose of one RGB image, {contract.pose}.

{listed}
- `contract.json`: what the models are fed and say, digests, and the poses of `frames/` that a port must find
- `trajectory.json`: where the training frames were taken
- `INTEGRATION.md`: how an app uses it
- `LICENSE.txt`

`mambaloc verify FOLDER` checks it, `mambaloc demo FOLDER` shows it in a browser. An app ships a
model, the map if there is one, and `contract.json`; `frames/` are for checking a port.

{_world(contract)}{_lens(contract)}## How sure it is

{_uncertainty(contract)}

## Trained

{trained}
"""


def _world(contract: Contract) -> str:
    if not any(contract.world.offset_m):
        return ""
    return f"""## Where in the world

The models, the map, `frames/` and `trajectory.json` are in the scene's own frame, so that float32 holds positions.
Add `world.offset_m` in `contract.json`, {list(contract.world.offset_m)}, to a position **in double precision** for the
world of the data that the scene was made of. `mambaloc.runtime.Localizer`, the trajectories of `mambaloc localize` and
the page in the browser do so already.

"""


def _lens(contract: Contract) -> str:
    if contract.intrinsics is None:
        return ""
    return """## Another lens

Images of any camera and shape are localized if their intrinsics are known. The models take them as a required input,
which `INTEGRATION.md` fills in with the training camera's, `intrinsics` in `contract.json`, where they are not.

"""


def _images(undistortion: Undistortion) -> str:
    """What images must be, and by which lens the camera's own become so."""
    must = "Images must be without lens distortion, as the training images are taken to be."
    lens, left = undistortion.lens, undistortion.leaves
    if lens is None or left is None:
        return f"""## Images

{must} The lens of their camera is not known here:
{undistortion.unknown}.
"""
    (width, height), (fx, fy), (cx, cy) = undistortion.stored, left.focal_px, left.center_px
    return f"""## Images

{must} Their camera stored these
as {width}x{height}, through a lens of OpenCV's {lens.name} model: `lens` of `undistortion` in `contract.json`.
Undistorting leaves {left.width}x{left.height} with the pinhole matrix
{fx:.2f} 0 {cx:.2f}, 0 {fy:.2f} {cy:.2f}, 0 0 1, which is `leaves` there. Images of the same camera need the same,
resized ones with both scaled: in Python, `Localizer.localize(picture, is_distorted=True)` and
`mambaloc localize --distorted`; in an app, OpenCV's `initUndistortRectifyMap` (for a fisheye,
`fisheye::initUndistortRectifyMap`) and `remap`, as `function` there says.
"""


def _uncertainty(contract: Contract) -> str:
    calibration = contract.uncertainty
    if calibration is None:
        return (
            "The models do not estimate it: too few frames are known to have been held out of their training to "
            "measure it on."
        )
    return (
        f"Beside the pose the models say `position_radius_m` and `rotation_radius_deg`: {calibration['level']:.0%} of "
        f"the {calibration['held_out_frames']} frames that were held out of training are within these of their true "
        "poses. "
        "`unfamiliarity` over 1 means that the image hardly looks like the place: do not use its pose."
    )


def _in_words(value: Any) -> str:
    return ", ".join(f"{k} {v}" for k, v in value.items()) if isinstance(value, dict) else str(value)
