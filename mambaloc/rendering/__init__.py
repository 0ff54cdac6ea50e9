"""Furnished rooms rendered by perspective: an embedded scene, and stand-ins for datasets, without a download."""

from mambaloc.renamed import renamed
from mambaloc.rendering.quads import Quad, Room, quad
from mambaloc.rendering.renderer import default_intrinsics, render, sensor
from mambaloc.rendering.room import furnished_room, room_around
from mambaloc.rendering.scenes.embedded import (
    EMBEDDED_SCENE,
    embedded_frames,
    embedded_room,
    embedded_walk,
    ensure_embedded_scene,
)
from mambaloc.rendering.scenes.layouts import GENERATOR_VERSION, write_7scenes, write_cambridge
from mambaloc.rendering.scenes.shots import Frame, frames_of_sequences, parse_size, read_pose_table, thinned
from mambaloc.rendering.trajectories import smooth_trajectory

__all__ = [
    "EMBEDDED_SCENE",
    "GENERATOR_VERSION",
    "Frame",
    "Quad",
    "Room",
    "default_intrinsics",
    "embedded_frames",
    "embedded_room",
    "embedded_walk",
    "ensure_embedded_scene",
    "frames_of_sequences",
    "furnished_room",
    "parse_size",
    "quad",
    "read_pose_table",
    "render",
    "room_around",
    "sensor",
    "smooth_trajectory",
    "thinned",
    "write_7scenes",
    "write_cambridge",
]

__getattr__ = renamed(
    __name__, {"Shot": "Frame", "embedded_shots": "embedded_frames", "shots_of_sequences": "frames_of_sequences"}
)
