"""Measure how far off a model's poses are through other lenses: test views of the embedded room by several cameras.

python tools/benchmarks/lenses.py MODEL [--every N]

MODEL is exported from a training on the embedded scene: a file or a bundle. Its map, if there is one, is left out.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mambaloc import provenance
from mambaloc.console import OptionParser, exit_on_input_error, whole_number
from mambaloc.errors import InputError
from mambaloc.images import Image
from mambaloc.rendering import default_intrinsics, embedded_room, render, sensor
from mambaloc.rendering.scenes.embedded import embedded_frames
from mambaloc.rendering.scenes.shots import Frame
from mambaloc.runtime import Localizer
from mambaloc.runtime.rotations import quaternion_from_matrix, rotation_error_deg

LENSES = {  # focal length over the training camera's, and (width, height) in pixels
    "f x 1, 4:3, as in training": (1.0, (320, 240)),
    "f x 0.8": (0.8, (320, 240)),
    "f x 1.25": (1.25, (320, 240)),
    "f x 1, 16:9": (1.0, (426, 240)),
    "f x 1, square": (1.0, (240, 240)),
    "f x 1, 3:4, upright": (1.0, (240, 320)),
}


@exit_on_input_error
def main() -> None:
    """Localize and print."""
    parser = OptionParser(description=__doc__)
    parser.add_argument("model", metavar="MODEL")
    parser.add_argument("--every", type=whole_number(1), default=1, help="of the test views, every so many-th")
    args = parser.parse_args()
    localizer = Localizer(args.model, 1, sparse_map=False)
    if localizer.contract is None or localizer.contract.intrinsics is None:
        raise InputError(f"{args.model}: takes no intrinsics. Give a model that does, such as DenseLoc's.")
    shots = [shot for shot in embedded_frames() if shot.split == "test"][:: args.every]
    print(provenance.machine())
    print(
        f"{len(shots)} views each; camera stated: median, mean, median over that of training; camera unstated: median"
    )
    training: NDArray[np.float64] | None = None
    for name in LENSES:
        stated, unstated = lens_errors(localizer, shots, name)
        median, mean = np.median(stated, axis=0), stated.mean(axis=0)
        training = median if training is None else training
        ratio_m, ratio_deg = median / training
        without = "too narrow" if unstated is None else in_words(np.median(unstated, axis=0))
        print(f"{name:27} {in_words(median)}, {in_words(mean)}, {ratio_m:.2f} {ratio_deg:.2f}; {without}", flush=True)


def in_words(error: NDArray[np.float64]) -> str:
    """Metres and degrees."""
    return f"{error[0]:.3f} m {error[1]:.2f} deg"


def lens_errors(
    localizer: Localizer, shots: Sequence[Frame], name: str
) -> tuple[NDArray[np.float64], NDArray[np.float64] | None]:
    """Errors (N, 2) in metres and degrees with the camera stated, and without; None where it must be."""
    zoom, size = LENSES[name]
    intrinsics = default_intrinsics(size)
    intrinsics[0, 0] = intrinsics[1, 1] = zoom * default_intrinsics((320, 240))[0, 0]
    room, stated, unstated = embedded_room(), [], []
    for number, shot in enumerate(shots):
        rgb = sensor(render(room, intrinsics, shot.world_from_cam, size)[0], np.random.default_rng(number))
        stated.append(error(localizer, rgb, intrinsics, shot))
        try:
            unstated.append(error(localizer, rgb, None, shot))
        except InputError:  # too narrow
            continue
    return np.array(stated), np.array(unstated) if unstated else None


def error(localizer: Localizer, rgb: Image, intrinsics: ArrayLike | None, shot: Frame) -> tuple[float, float]:
    """Of one view, in metres and degrees."""
    found = localizer.localize(rgb, intrinsics)
    off_m = float(np.linalg.norm(found.position_m - shot.world_from_cam[:3, 3]))
    return off_m, float(rotation_error_deg(found.quaternion, quaternion_from_matrix(shot.world_from_cam[:3, :3])))


if __name__ == "__main__":
    main()
