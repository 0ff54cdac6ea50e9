"""Frames, units and the records that cross every border: the one page on conventions.

Convention
    A pose is ``world_from_cam``: it takes a point in camera coordinates to world coordinates,
    ``p_world = R @ p_cam + t``, so its translation is the camera centre in the world.

    =============  ==========================================================================
    position       metres, in the scene's world frame: names end in ``_m``
    rotation       unit quaternion, scalar first (**wxyz**), canonical sign ``w >= 0``
    camera axes    OpenCV: x right, y down, z forward
    composition    ``a_from_c = a_from_b @ b_from_c``: inner names cancel
    angles         degrees where a person reads them (``_deg``), radians in formulas (``_rad``)
    images         RGB; ``uint8`` 0..255 in storage, ``float32`` 0..1 as network input,
                   which normalises by its backbone's own mean and deviation
    pixels         ``(x, y)``, the centre of the top-left pixel at ``(0, 0)`` (OpenCV)
    =============  ==========================================================================

    Every reader converts to this at its border; nothing inside the package knows another convention.

Shape suffixes
    ``B`` batch, ``N`` tokens or points, ``C`` channels, ``H W`` rows and columns, ``L`` sequence length,
    ``D`` feature width, ``E`` inner width and ``S`` state size of a state-space mixer.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any

from torch import Tensor

from mambaloc.geometry.poses import Pose as Pose


@dataclass  # not frozen: Lightning fills a copy when it moves a batch to a device
class PoseBatch:
    """Images with their true poses, as the data module hands them to a system.

    Shape:
        ``image`` (B, 3, H, W): ``uint8`` as loaded, ``float32`` in 0..1 once on the device and augmented.
        ``position_m`` (B, 3) and ``quaternion`` (B, 4): the true ``world_from_cam``.
        ``index`` (B,): the frame's row in its split, which names it in every report.
        ``clip_length``: so many successive rows are frames of one sequence, in time order; B is a multiple of it.
        ``points_m`` (B, P, 3): scene points that each frame may see, world frame, NaN where it has fewer than P.
        ``intrinsics`` (B, 3, 3): pinhole matrices in pixels of ``image``, no skew; the data module always gives them.
        ``holes`` (B, H, W) bool: pixels of synthetic views that show nothing of the scene; None without synthetic
        views. ``scene`` (B,): which scene of several each image shows, in whose frame its pose is; None where there is
        one.
    """

    image: Tensor
    position_m: Tensor
    quaternion: Tensor
    index: Tensor
    clip_length: int = 1
    points_m: Tensor | None = None
    intrinsics: Tensor | None = None
    holes: Tensor | None = None
    scene: Tensor | None = None

    def pin_memory(self) -> PoseBatch:
        """Copy to page-locked memory; the DataLoader calls it where ``pin_memory=True``."""
        tensors: dict[str, Any] = {f.name: v for f in fields(self) if isinstance(v := getattr(self, f.name), Tensor)}
        return replace(self, **{name: tensor.pin_memory() for name, tensor in tensors.items()})


def height_and_width(size: int | tuple[int, int]) -> tuple[int, int]:
    """Read an image size: a square's side, or (height, width)."""
    return (size, size) if isinstance(size, int) else (size[0], size[1])


@dataclass  # not frozen, as PoseBatch
class CellPrediction:
    """What each cell of a dense head's feature map says of an image; N cells, row after row.

    Shape:
        ``rays_cam`` (B, N, 3): unit directions of the cells' centres in the camera, known from its intrinsics.
        ``rays_world`` (B, N, 3): in which direction of the world a cell looks, unit; or None.
        ``position_m`` (B, N, 3): where a cell takes the camera's centre to be.
        ``points_m`` (B, N, 3): the scene point that a cell sees, world frame; or None.
        ``rotation_weights`` and ``position_weights`` (B, N): what each counts in the pose, of sum 1.
        ``grid``: rows and columns; N is their product.
    """

    rays_cam: Tensor
    rays_world: Tensor | None
    position_m: Tensor
    points_m: Tensor | None
    rotation_weights: Tensor
    position_weights: Tensor
    grid: tuple[int, int]


@dataclass  # not frozen, as PoseBatch
class PosePrediction:
    """What a localizer says of a batch of images.

    Shape:
        ``position_m`` (B, 3) in metres. ``quaternion`` (B, 4) as the network regressed it: the loss and the
        metrics normalise it, ``mambaloc.geometry.canonical`` makes it a unit quaternion with ``w >= 0``.
        ``log_quaternion`` (B, 3): the output of a system that regresses it; ``quaternion`` is its exponential.
        ``auxiliary``: what auxiliary heads say while training.
        ``cells``: what a dense head's cells say, out of which it solves the pose.
        ``scene_logits`` (B, S): of a network that knows several scenes, how each fits the image. The pose is in the
        frame of the scene that it was asked for, or else of the likeliest one.
    """

    position_m: Tensor
    quaternion: Tensor
    log_quaternion: Tensor | None = None
    auxiliary: tuple[PosePrediction, ...] = ()
    cells: CellPrediction | None = None
    scene_logits: Tensor | None = None
