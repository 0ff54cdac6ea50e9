"""Furnished rooms rendered by perspective: an embedded scene, and stand-ins for datasets, without a download."""

from mambaloc.data.rendering.embedded import (
    EMBEDDED_SCENE,
    embedded_room,
    embedded_shots,
    embedded_walk,
    ensure_embedded_scene,
)
from mambaloc.data.rendering.layouts import GENERATOR_VERSION, write_7scenes, write_cambridge
from mambaloc.data.rendering.quads import Quad, Room, quad
from mambaloc.data.rendering.renderer import default_intrinsics, render, sensor
from mambaloc.data.rendering.room import furnished_room, room_around
from mambaloc.data.rendering.shots import Shot, parse_size, read_pose_table, shots_of_sequences, thinned
from mambaloc.data.rendering.trajectories import smooth_trajectory

__all__ = [
    "EMBEDDED_SCENE",
    "GENERATOR_VERSION",
    "Quad",
    "Room",
    "Shot",
    "default_intrinsics",
    "embedded_room",
    "embedded_shots",
    "embedded_walk",
    "ensure_embedded_scene",
    "furnished_room",
    "parse_size",
    "quad",
    "read_pose_table",
    "render",
    "room_around",
    "sensor",
    "shots_of_sequences",
    "smooth_trajectory",
    "thinned",
    "write_7scenes",
    "write_cambridge",
]
