"""A sparse map: points of a place and what they look like, in one file."""

from __future__ import annotations

import json
import math
import zlib
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.numpy import load, save

from mambaloc.errors import InputError
from mambaloc.files import atomic_file, writing
from mambaloc.images import LARGEST_SIDE_PX
from mambaloc.runtime.maps.acceptance import RULE
from mambaloc.runtime.maps.drift import NUGGET
from mambaloc.runtime.maps.features import check_intrinsics
from mambaloc.runtime.maps.lens import Lens
from mambaloc.runtime.undistortion import Undistortion
from mambaloc.runtime.world import World

VERSION = 2
"""Of files whose drift has changed since the map was built; others are of version 1."""
MAP_FILE = "map.safetensors"
"""What a map is called in the folders that tools write."""
_MAX_POINTS = 10**7
_MAX_BYTES = 2**31
_DAMAGE = (ValueError, KeyError, TypeError, RecursionError, MemoryError, SafetensorError)


@dataclass(frozen=True)
class SparseMap:
    """Points triangulated from posed frames, each with the mean descriptor of its views; the most seen come first.

    Shape:
        ``points_m`` (P, 3) float32, world frame, metres; ``descriptors`` (P, 128) uint8, RootSIFT, see
        :data:`~mambaloc.runtime.maps.features.DESCRIPTOR_SCALE`; ``views`` (P, ceil(K / 8)) uint8, bits as
        ``numpy.packbits`` writes them; ``key_poses`` (K, 4, 4) and ``intrinsics`` (3, 3) float64.

    Args:
        points_m: positions of the points.
        descriptors: one a point.
        views: which key frames see each point.
        key_poses: ``world_from_cam`` of the key frames, adjusted to the images as the points are.
        size: (width, height) of the images in which keypoints were searched.
        intrinsics: of their camera, of the first key frame where there are several.
        least_inliers: matches that a pose needs to be accepted.
        scene: name of the place.
        digests: of what the map was made from, by name.
        lens: how the camera differs from ``intrinsics``.
        drift: (K, 6), carries poses to the frame of the given ones, see
            :func:`~mambaloc.runtime.maps.drift.fit_drift`; (0, 6) where that is the map's own. Rows of 0 stand for
            key frames that came without a pose.
        nugget: with which the drift was fitted.
        sessions: what was added later: how many key frames each has by its name, in the order of ``key_poses``, whose
            last they are.
        first_drift: ``drift`` before any key frame was added; (0, 6) where it has not changed since.
        world: where the scene's frame lies in that of the data it was made of.
        undistortion: how its images were made of what their camera stored.
    """

    points_m: NDArray[np.float32]
    descriptors: NDArray[np.uint8]
    views: NDArray[np.uint8]
    key_poses: NDArray[np.float64]
    size: tuple[int, int]
    intrinsics: NDArray[np.float64]
    least_inliers: int
    scene: str
    digests: dict[str, str] = field(default_factory=dict)
    lens: Lens = field(default_factory=Lens)
    drift: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 6)))
    nugget: float = NUGGET
    sessions: dict[str, int] = field(default_factory=dict)
    first_drift: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 6)))
    world: World = field(default_factory=World)
    undistortion: Undistortion = field(default_factory=Undistortion)

    def __len__(self) -> int:
        return len(self.points_m)

    @property
    def is_seen(self) -> NDArray[np.bool_]:
        """Which key frames (columns) see which points (rows), (P, K)."""
        return np.unpackbits(self.views, axis=1, count=len(self.key_poses)).view(bool)

    @property
    def has_grown_drift(self) -> bool:
        """Whether key frames that were added changed the drift."""
        return len(self.drift) > len(self.key_poses) - sum(self.sessions.values())

    def save(self, path: Path) -> None:
        """Write it to a safetensors file, whole or not at all.

        The header's metadata hold one entry, ``about``: JSON with the format's version, the scene, the version of the
        rule of acceptance and the inliers that this map asks for besides, the drift's nugget, digests, and a CRC-32 of
        the arrays in the order of their names.

        Raises:
            InputError: where it cannot be written.
        """
        arrays: dict[str, NDArray[Any]] = {
            "points_m": self.points_m,
            "descriptors": self.descriptors,
            "views": self.views,
            "key_poses": self.key_poses,
            "size": np.array(self.size, np.int64),
            "intrinsics": self.intrinsics,
            "lens": self.lens.numbers,
            "drift": self.drift,
        }
        if self.has_grown_drift:
            arrays["first_drift"] = self.first_drift
        about = {
            "version": VERSION if "first_drift" in arrays else 1,
            "scene": self.scene,
            "least_inliers": self.least_inliers,
            "rule": RULE,
            "nugget": self.nugget,
            "digests": self.digests,
            "sessions": self.sessions,
            "world": asdict(self.world),
            "undistortion": self.undistortion.to_json(),
            "crc32": _crc32(arrays),
        }
        whole = {name: np.ascontiguousarray(array) for name, array in arrays.items()}
        with writing(path, "free some space, or choose another folder"):
            path.parent.mkdir(parents=True, exist_ok=True)
            with atomic_file(path) as partial:
                partial.write_bytes(save(whole, {"about": json.dumps(about)}))

    @classmethod
    def load(cls, path: Path) -> SparseMap:
        """Read a file that :meth:`save` wrote; nothing in it is ever unpickled.

        Raises:
            InputError: where it is missing, damaged, not a map, or of a newer version.
        """
        try:
            if path.stat().st_size > _MAX_BYTES:
                raise ValueError(f"it is larger than {_MAX_BYTES} bytes")
            data = path.read_bytes()
            arrays = load(data)  # checks the header's length and offsets, so that the header can be read
            about = json.loads(json.loads(data[8 : 8 + int.from_bytes(data[:8], "little")])["__metadata__"]["about"])
            if about["version"] <= VERSION:
                return cls._checked(about, {"first_drift": np.zeros((0, 6)), **arrays})
        except OSError as error:
            raise InputError(f"{path}: cannot be read ({error.strerror or error}). mambaloc map writes maps.") from None
        except (*_DAMAGE, InputError) as error:
            reason = str(error).splitlines()[0] if str(error) else type(error).__name__
            raise InputError(f"{path}: is damaged or not a map ({reason}). Build the map again.") from None
        raise InputError(
            f"{path}: has version {about['version']}, and this program reads versions up to {VERSION}. Update mambaloc."
        )

    @classmethod
    def _checked(cls, about: dict[str, Any], arrays: dict[str, NDArray[Any]]) -> SparseMap:
        for name, (dtype, shape) in _ARRAYS.items():
            given = arrays[name]
            fits = len(given.shape) == len(shape) and all(b in (0, a) for a, b in zip(given.shape, shape, strict=True))
            if given.dtype != dtype or not fits:
                raise ValueError(f"{name} is {given.dtype} {given.shape}")
        if about["crc32"] != _crc32({name: arrays[name] for name in _ARRAYS}):
            raise ValueError("its checksum differs")
        points, key_poses, (width, height) = arrays["points_m"], arrays["key_poses"], map(int, arrays["size"])
        counts = {len(points), len(arrays["descriptors"]), len(arrays["views"])}
        if len(counts) != 1 or not 0 < len(points) <= _MAX_POINTS:
            raise ValueError(f"{counts} points, descriptors and views")
        if not len(key_poses) or arrays["views"].shape[1] != -(-len(key_poses) // 8):
            raise ValueError(f"{len(key_poses)} key frames in views of {arrays['views'].shape[1]} bytes")
        sessions = {str(name): int(count) for name, count in dict(about.get("sessions", {})).items()}
        if any(count < 1 for count in sessions.values()) or sum(sessions.values()) >= len(key_poses):
            raise ValueError(f"sessions of {sum(sessions.values())} of {len(key_poses)} key frames")
        first, drift = len(key_poses) - sum(sessions.values()), len(arrays["drift"])
        if (drift and not first <= drift <= len(key_poses)) or len(arrays["first_drift"]) not in (0, first):
            raise ValueError(f"drift of {drift} key frames of {len(key_poses)}")
        if not all(np.isfinite(arrays[name]).all() for name in _ARRAYS if _ARRAYS[name][0] != np.uint8):
            raise ValueError("numbers are not finite")
        if not 0 < width <= LARGEST_SIDE_PX or not 0 < height <= LARGEST_SIDE_PX:
            raise ValueError(f"images of {width}x{height}")
        if not 0 < (nugget := float(about.get("nugget", NUGGET))) < math.inf:
            raise ValueError(f"nugget of {nugget}")
        check_intrinsics(arrays["intrinsics"], (width, height))
        return cls(
            points, arrays["descriptors"], arrays["views"], key_poses, (width, height), arrays["intrinsics"],
            int(about["least_inliers"]), str(about["scene"]),
            {str(name): str(digest) for name, digest in dict(about["digests"]).items()},
            Lens(*map(float, arrays["lens"])), arrays["drift"], nugget, sessions, arrays["first_drift"],
            World.from_json(about.get("world")), Undistortion.from_json(about.get("undistortion")),
        )  # fmt: skip


_ARRAYS = {  # a side of 0 may have any length
    "points_m": (np.float32, (0, 3)),
    "descriptors": (np.uint8, (0, 128)),
    "views": (np.uint8, (0, 0)),
    "key_poses": (np.float64, (0, 4, 4)),
    "size": (np.int64, (2,)),
    "intrinsics": (np.float64, (3, 3)),
    "lens": (np.float64, (2,)),
    "drift": (np.float64, (0, 6)),
    "first_drift": (np.float64, (0, 6)),
}


def _crc32(arrays: dict[str, NDArray[Any]]) -> int:
    """Of all bytes: safetensors itself does not notice a changed number."""
    return zlib.crc32(b"".join(arrays[name].tobytes() for name in sorted(arrays)))
