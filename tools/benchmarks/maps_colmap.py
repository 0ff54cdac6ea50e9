"""pycolmap's own route: SIFT, triangulation with given poses, retrieval, matching, and the pose of a query.

Retrieval compares VLADs (Jégou et al. 2010) of COLMAP's SIFT, with a codebook of the key frames' own descriptors:
pycolmap comes without a vocabulary tree.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from mambaloc.data.colmap import import_pycolmap
from mambaloc.images import CORNER_PX, read_image
from mambaloc.mapping.building import PosedFrames
from mambaloc.mapping.pairs import pairs_by_pose
from mambaloc.runtime.maps.features import rescaled_intrinsics

Floats = NDArray[np.floating[Any]]

_RETRIEVED = 10  # key frames
_WORDS = 32  # of the codebook


@dataclass(frozen=True)
class WrittenImages:
    """Frames of one camera as files of one size.

    Shape:
        ``intrinsics`` (3, 3), where the centre of the top-left pixel is (0, 0); ``world_from_cam`` (N, 4, 4).
    """

    folder: Path
    names: list[str]
    size: tuple[int, int]
    intrinsics: NDArray[np.float64]
    world_from_cam: NDArray[np.float64]

    @classmethod
    def write(cls, frames: PosedFrames, width: int, folder: Path) -> WrittenImages:
        """Write frames as PNG of a width."""
        folder.mkdir(parents=True)
        names = [f"{folder.name}_{number:05d}.png" for number in range(len(frames))]
        for name, image in zip(names, frames.images, strict=True):
            rgb = read_image(image) if isinstance(image, Path) else image
            size = (width, round(rgb.shape[0] * width / rgb.shape[1]))
            cv2.imwrite(str(folder / name), cv2.resize(rgb, size, interpolation=cv2.INTER_AREA)[..., ::-1])
        intrinsics = rescaled_intrinsics(frames.intrinsics[0], (rgb.shape[1], rgb.shape[0]), size)
        return cls(folder, names, size, intrinsics, frames.world_from_cam)

    def __len__(self) -> int:
        return len(self.names)

    @property
    def frames(self) -> PosedFrames:
        """The same as frames that a map is built from."""
        paths = [self.folder / name for name in self.names]
        return PosedFrames(paths, np.repeat(self.intrinsics[None], len(self), axis=0), self.world_from_cam)


@dataclass
class ColmapRoute:
    """A model of key frames, and queries localized in it.

    Args:
        key: the key frames.
        work: an empty folder for the database and the model.
        seed: of every RANSAC.
    """

    key: WrittenImages
    work: Path
    seed: int = 0

    @cached_property
    def colmap(self) -> Any:
        """The module pycolmap, with its log kept to itself."""
        pycolmap = import_pycolmap(self.work)
        pycolmap.logging.minloglevel = pycolmap.logging.FATAL.value
        pycolmap.set_random_seed(self.seed)
        return pycolmap

    @property
    def database(self) -> Path:
        """Of keypoints, descriptors and matches."""
        return self.work / "database.db"

    def camera(self, number: int) -> Any:
        """The camera in COLMAP's pixels, which count from the corner."""
        focal_x, focal_y = np.diag(self.key.intrinsics)[:2]
        center = self.key.intrinsics[:2, 2] + CORNER_PX
        width, height = self.key.size
        params = (focal_x, focal_y, *center)
        return self.colmap.Camera(camera_id=number, model="PINHOLE", width=width, height=height, params=params)

    def find_features(self, images: WrittenImages) -> None:
        """Find SIFT of images, with COLMAP's defaults, on one thread."""
        colmap, mode = self.colmap, self.colmap.CameraMode.SINGLE
        reader = colmap.ImageReaderOptions(camera_model="PINHOLE")
        reader.camera_params = ",".join(map(str, self.camera(1).params))
        with colmap.Database.open(self.database):  # which makes it
            pass
        options = colmap.FeatureExtractionOptions(num_threads=1, use_gpu=False)
        colmap.extract_features(self.database, images.folder, images.names, mode, reader, options)

    def match(self, pairs: Sequence[tuple[str, str]], is_verified: bool) -> None:
        """Match pairs of images."""
        listed = self.work / "pairs.txt"
        listed.write_text("".join(f"{a} {b}\n" for a, b in pairs), encoding="utf-8")
        matching = self.colmap.FeatureMatchingOptions(num_threads=1, use_gpu=False)
        matching.skip_geometric_verification = not is_verified
        verification = self.colmap.TwoViewGeometryOptions()
        verification.ransac.random_seed = self.seed
        pairing = self.colmap.ImportedPairingOptions(match_list_path=listed)
        self.colmap.match_image_pairs(self.database, matching, pairing, verification)

    def build(self) -> None:
        """Triangulate key frames with their given poses, and make the index that finds them."""
        colmap, key = self.colmap, self.key
        self.find_features(key)
        self.match([(key.names[a], key.names[b]) for a, b in pairs_by_pose(key.world_from_cam)], is_verified=True)
        with colmap.Database.open(self.database) as database:
            images = [database.read_image_with_name(name) for name in key.names]
            descriptors = [database.read_descriptors(image.image_id).data for image in images]
        model = colmap.Reconstruction()
        model.add_camera_with_trivial_rig(self.camera(images[0].camera_id))
        for image, pose in zip(images, np.linalg.inv(key.world_from_cam), strict=True):
            fresh = colmap.Image(name=image.name, camera_id=image.camera_id, image_id=image.image_id)
            model.add_image_with_trivial_frame(fresh, colmap.Rigid3d(pose[:3]))
        options = colmap.IncrementalPipelineOptions(num_threads=1, random_seed=self.seed, extract_colors=False)
        (self.work / "model").mkdir()
        self.model = colmap.triangulate_points(
            model, self.database, key.folder, self.work / "model", True, options, refine_intrinsics=False
        )
        self.key_ids = [image.image_id for image in images]
        self.words = _codebook(np.concatenate(descriptors), self.seed)
        self.index = np.stack([_vlad(each, self.words) for each in descriptors])
        self.points = {  # of each key frame's keypoints, and which have one
            number: [(i, p.point3D_id) for i, p in enumerate(self.model.image(number).points2D) if p.has_point3D()]
            for number in self.key_ids
        }

    def bytes(self) -> int:
        """What must be shipped: the model, the key frames' descriptors, codebook and index as float16."""
        with self.colmap.Database.open(self.database) as database:
            descriptors = sum(database.read_descriptors(number).data.nbytes for number in self.key_ids)
        model = sum(path.stat().st_size for path in (self.work / "model").iterdir())
        return model + descriptors + 2 * (self.words.size + self.index.size)

    def localize(self, queries: WrittenImages) -> list[Floats | None]:
        """Localize queries, all of each step together: ``world_from_cam`` (4, 4), or None, of each."""
        self.find_features(queries)
        with self.colmap.Database.open(self.database) as database:
            numbers = [database.read_image_with_name(name).image_id for name in queries.names]
            vlads = np.stack([_vlad(database.read_descriptors(number).data, self.words) for number in numbers])
            nearest = np.argsort(-vlads @ self.index.T, axis=1, kind="stable")[:, :_RETRIEVED]
        self.match(
            [(name, self.key.names[row]) for name, rows in zip(queries.names, nearest, strict=True) for row in rows],
            is_verified=False,
        )
        with self.colmap.Database.open(self.database) as database:
            return [
                self._pose(database, number, [self.key_ids[row] for row in rows])
                for number, rows in zip(numbers, nearest, strict=True)
            ]

    def _pose(self, database: Any, number: int, keys: Sequence[int]) -> Floats | None:
        """The pose that matches of one query with key frames give."""
        pixels, seen = database.read_keypoints(number)[:, :2], set()
        for key in keys:
            if not database.exists_matches(number, key):
                continue
            point_of = dict(self.points[key])
            for own, theirs in database.read_matches(number, key):
                if theirs in point_of:
                    seen.add((int(own), point_of[theirs]))
        if len(seen) < 4:
            return None
        rows, points = zip(*sorted(seen), strict=True)
        options = self.colmap.AbsolutePoseEstimationOptions()
        options.ransac.random_seed = self.seed
        options.ransac.max_error = 4.5 * self.key.size[0] / 160  # as ours: given poses drift by that much
        found = self.colmap.estimate_and_refine_absolute_pose(
            pixels[list(rows)], np.array([self.model.point3D(p).xyz for p in points]), self.camera(1), options
        )
        if found is None:
            return None
        pose = np.eye(4)
        pose[:3] = found["cam_from_world"].inverse().matrix()
        return pose


def _codebook(descriptors: NDArray[np.uint8], seed: int) -> Floats:
    cv2.setRNGSeed(seed)
    until = (cv2.TERM_CRITERIA_MAX_ITER, 20, 0)
    data = descriptors.astype(np.float32)
    return np.asarray(cv2.kmeans(data, _WORDS, None, until, 1, cv2.KMEANS_PP_CENTERS)[2])  # type: ignore[call-overload]


def _vlad(descriptors: NDArray[np.uint8], words: Floats) -> Floats:
    """Residuals to the nearest word, summed by word, each sum and then the vector made unit long; (words * 128,)."""
    data = descriptors.astype(np.float32)
    nearest = (data @ words.T - (words**2).sum(axis=1) / 2).argmax(axis=1)
    sums = np.zeros_like(words)
    np.add.at(sums, nearest, data - words[nearest])
    sums /= np.maximum(np.linalg.norm(sums, axis=1, keepdims=True), 1e-9)
    return np.asarray((sums / np.maximum(np.linalg.norm(sums), 1e-9)).ravel())
