"""What is sound about a capture and what is not: each check a line, and a verdict of all checks."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from mambaloc.data.frames import FARTHEST, ROTATION_TOLERANCE
from mambaloc.importing.capture import Capture
from mambaloc.importing.checks.findings import Finding
from mambaloc.importing.motion import Motion, quaternions, sides_of
from mambaloc.importing.undistort.decoding import Decoding
from mambaloc.runtime.camera_models import is_same_shape
from mambaloc.runtime.rotations import is_rotation

MIN_FRAMES = 20
_DUPLICATE_SHARE = 1e-6  # of the extent
_DUPLICATE_DEG = 1e-3
_MANY = 0.1
_NAMED = 3
_MIN_STILL = 3  # successive frames
_MUCH = 2.0


def bad_poses(world_from_cam: NDArray[np.float64]) -> dict[int, str]:
    """The rule that a frame's pose breaks, by row.

    Args:
        world_from_cam: (N, 4, 4).
    """
    found = {}
    is_finite = np.isfinite(world_from_cam).all(axis=(1, 2))
    is_right = is_rotation(world_from_cam[:, :3, :3], ROTATION_TOLERANCE)
    for row in np.flatnonzero(~(np.asarray(is_finite) & is_right)).tolist():
        pose = world_from_cam[row]
        found[row] = _broken(pose) if np.isfinite(pose).all() else "pose has NaN or infinite numbers"
    return found


def far_poses(world_from_cam: NDArray[np.float64]) -> dict[int, str]:
    """The rule that frames too far from the origin to be read back break, by row; poses as :func:`bad_poses`."""
    is_far = (np.abs(world_from_cam[:, :3, 3]) > FARTHEST).any(axis=1)
    return dict.fromkeys(np.flatnonzero(is_far).tolist(), f"position is farther than {FARTHEST:g} from the origin")


def _broken(pose: NDArray[np.float64]) -> str:
    rotation = pose[:3, :3]
    determinant = float(np.linalg.det(rotation))
    scale = abs(determinant) ** (1 / 3)
    if scale < 1e-6 or not np.allclose(rotation @ rotation.T, scale**2 * np.eye(3), atol=ROTATION_TOLERANCE * scale**2):
        return "pose's rotation is not orthonormal"
    if determinant < 0:
        return "pose's rotation is left-handed: an axis is mirrored"
    return f"pose's rotation is scaled by {scale:.4g}"


def check_frames(capture: Capture, left_out: Mapping[str, str]) -> Finding:
    """Count frames and those left out; if too few are left, name every known cause.

    Args:
        capture: of those that are left.
        left_out: the rule that others break, by name.
    """
    kept, rules = len(capture.images), Counter(rule.partition(" (")[0] for rule in left_out.values())
    causes = [f"{count} left out: {rule}" for rule, count in rules.most_common()]
    message = "; ".join((f"{kept}", *causes[:_NAMED]))
    figures = {"kept": kept, "left_out": dict(rules)}
    if kept < MIN_FRAMES:
        causes += _without(capture)
        concern = f"{kept} usable frames, and {MIN_FRAMES} are needed to train on some and to test on others"
        concern += f" ({'; '.join(causes)})" if causes else ""
        return Finding("frames", message, concern, is_fatal=True, figures=figures)
    concern = ""
    if left_out:
        concern = f"{len(left_out)} of {kept + len(left_out)} frames are left out ({rules.most_common(1)[0][0]})"
    return Finding("frames", message, concern, figures=figures)


def _without(capture: Capture) -> list[str]:
    """Poses without an image and images without a pose, as causes."""
    found = []
    if missing := capture.poses_without_image:
        found.append(f"{len(missing)} poses without an image, as of {_some(missing)}")
    if beside := capture.images_without_pose:
        found.append(f"{len(beside)} images without a pose, as {_some([image.name for image in beside])}")
    return found


def check_missing(capture: Capture) -> Finding:
    """Say which images have no pose and which poses no image."""
    without_image, without_pose = capture.poses_without_image, capture.images_without_pose
    message = f"{len(without_image)} without image, {len(without_pose)} images without pose"
    if without_image:
        message += f" ({_some(without_image)})"
    listed = len(capture.images) + len(without_image)
    concern = ""
    if len(without_image) > _MANY * listed:
        concern = f"{len(without_image)} of {listed} poses have no image"
    elif len(without_pose) > len(capture.images):
        concern = f"{len(without_pose)} images have no pose, more than have one"
    figures = {"poses_without_image": len(without_image), "images_without_pose": len(without_pose)}
    return Finding("poses", message, concern, figures=figures)


def check_sizes(sizes: Sequence[tuple[int, int]]) -> Finding:
    """Say how large the images are, (width, height) of each."""
    counted = Counter(sizes).most_common(_NAMED)
    message = ", ".join(
        f"{width}x{height}" + (f" ({count})" if len(counted) > 1 else "") for (width, height), count in counted
    )
    odd = sum(not is_same_shape(size, counted[0][0]) for size in sizes)
    concern = ""
    if odd:
        concern = (
            f"{odd} images are shaped otherwise than most: all are used, and a training sees of each the middle that "
            "every shape holds; data.image_size must be square for upright and lying ones"
        )
    figures = {"sizes": {f"{width}x{height}": count for (width, height), count in counted}, "of_another_shape": odd}
    return Finding("image size", message, concern, figures=figures)


def check_pixels(decoding: Decoding) -> Finding:
    """Say which pixels of an image with an EXIF orientation its pose means."""
    concern = ""
    if decoding.stored and not decoding.known:
        concern = (
            f"{len(decoding.stored)} images have an EXIF orientation, and the format does not say whether poses mean "
            "stored or upright pixels: taken as stored. If they mean upright ones, write the images so first, as "
            "mogrify -auto-orient does"
        )
    figures = {"turned": len(decoding.turned), "stored": len(decoding.stored)}
    return Finding("pixels", decoding.choices()["pixels"], concern, figures=figures)


def check_steps(capture: Capture, motion: Motion, unit: str) -> Finding:
    """Say how far the camera moves from a frame to the next, and where it jumps."""
    jumps = [capture.images[row].name for row in motion.jumps.tolist()]
    figures = {
        "median": round(motion.step, 6),
        "median_deg": round(motion.step_deg, 3),
        "in_order": motion.in_order,
        "jumps": jumps,
    }
    if not motion.in_order:
        message = f"no path; the nearest frame is {motion.step:.3g} {unit} and {motion.step_deg:.1f}° away (median)"
        concern = "the frames are in no order of time: a split by blocks is one by place, and clips make no sense"
        return Finding("steps", message, concern, figures=figures)
    largest = f"{motion.length.max():.3g} {unit}"
    message = f"median {motion.step:.3g} {unit} and {motion.step_deg:.1f}°, largest {largest}; {len(jumps)} jumps"
    concern = f"the camera jumps {len(jumps)} times (to {_some(jumps)})" if jumps else ""
    return Finding("steps", message, concern, figures=figures)


def check_duplicates(capture: Capture, motion: Motion) -> Finding:
    """Say how many frames have exactly the pose of another."""
    grid = np.concatenate(
        (
            capture.world_from_cam[:, :3, 3] / max(_DUPLICATE_SHARE * motion.extent, 1e-12),
            quaternions(capture) / np.radians(_DUPLICATE_DEG),
        ),
        axis=1,
    ).round()
    many = len(grid) - len(np.unique(grid, axis=0))
    run, concern = _longest_run(grid, capture.sequences), ""
    if many >= len(grid) - 1:
        concern = "all frames have the same pose: the tracker was lost, or did not move; export poses that differ"
        return Finding("duplicate poses", f"{many}", concern, True, {"count": many})
    if len(run) >= _MIN_STILL:
        first, last = (capture.images[run[end]].name for end in (0, -1))
        concern = (
            f"{many} frames have exactly the pose of another, most in a row {first} to {last} ({len(run)} frames): a "
            "tracker that is lost repeats its last pose; if these images show that the camera moved, take them and "
            "their poses out of the capture and import it again"
        )
    elif many > _MANY * len(grid):
        concern = (
            f"{many} frames have exactly the pose of another: images may be there twice, or poses with too few "
            "digits; remove copies, or export poses with six decimals"
        )
    return Finding("duplicate poses", f"{many}", concern, figures={"count": many})


def _longest_run(grid: NDArray[np.float64], sequences: Sequence[str]) -> NDArray[np.int64]:
    """The rows of the longest run of successive frames of a sequence with the same pose."""
    names = np.array(sequences)
    changes = (grid[1:] != grid[:-1]).any(axis=1) | (names[1:] != names[:-1])
    return max(np.split(np.arange(len(grid)), 1 + np.flatnonzero(changes)), key=len)


def check_extent(capture: Capture, motion: Motion, unit: str) -> Finding:
    """Say how large the box around nine tenths of the camera centres is, and around all where that is much larger."""
    position = capture.world_from_cam[:, :3, 3]
    sides, all_sides = sides_of(position), np.ptp(position, axis=0)
    message = f"{' x '.join(f'{side:.3g}' for side in sides)} {unit} along x, y, z (nine tenths of the frames)"
    if np.linalg.norm(all_sides) > _MUCH * np.linalg.norm(sides):
        message += f"; of all frames {' x '.join(f'{side:.3g}' for side in all_sides)}"
    figures = {
        "sides": sides.round(6).tolist(),
        "sides_of_all": all_sides.round(6).tolist(),
        "diagonal_of_nine_tenths": round(motion.extent, 6),
    }
    return Finding("extent", message, figures=figures)


def check_times(capture: Capture) -> Finding:
    """Say whether time goes forward within each sequence."""
    if capture.time_s is None:
        return Finding("time", "not in the format")
    names = np.array(capture.sequences)
    steps = np.diff(capture.time_s)[names[1:] == names[:-1]]
    backwards, still = int((steps < 0).sum()), int((steps == 0).sum())
    message = (
        f"median {np.median(steps):.3g} s from frame to frame, longest {steps.max():.3g} s"
        if len(steps)
        else "one frame"
    )
    concern = ""
    if backwards or still:
        concern = f"time goes back {backwards} times and stands still {still} times from a frame to the next"
    return Finding("time", message, concern, figures={"backwards": backwards, "still": still})


def _some(names: Sequence[str]) -> str:
    return ", ".join(names[:_NAMED]) + (", ..." if len(names) > _NAMED else "")
