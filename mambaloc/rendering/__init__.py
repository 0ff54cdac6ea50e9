"""Furnished rooms rendered by perspective: an embedded scene, and stand-ins for datasets, without a download."""

from mambaloc.rendering.quads import Quad, Room, quad
from mambaloc.rendering.renderer import default_intrinsics, render, sensor
from mambaloc.rendering.room import furnished_room, room_around
from mambaloc.rendering.scenes.embedded import (
    EMBEDDED_SCENE,
    embedded_room,
    embedded_shots,
    embedded_walk,
    ensure_embedded_scene,
)
from mambaloc.rendering.scenes.layouts import GENERATOR_VERSION, write_7scenes, write_cambridge
from mambaloc.rendering.scenes.shots import Shot, parse_size, read_pose_table, shots_of_sequences, thinned
from mambaloc.rendering.trajectories import smooth_trajectory

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
