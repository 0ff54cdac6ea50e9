#!/usr/bin/env bash
# Package:  kapture 1.1.12
# Guess:    Trajectories.intermediate_pose of a camera that stays where it is, and only turns, is where the camera is.
# Seen:     it is elsewhere. Poses are world-to-device, and their translations -R C are interpolated as they are, between the
#           rotations: the camera centre leaves the straight line between its two ends, by more the farther the world's
#           origin is. A camera 100 m from the origin that turns by 20 degrees is 1.5 m off halfway; of the inverse
#           trajectory, device-to-world, the same function gives the centre exactly.
# Hurts:    users who give pictures or LiDAR scans the poses of a tracker with other time stamps, in a map's grid or a large
#           building: errors of centimetres to metres wherever the device turns, with smooth paths that look right.
# Remedy:   interpolate trajectories.inverse(), and invert the pose.
set -euo pipefail
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
python3 -m venv "$work/venv"
"$work/venv/bin/pip" install -q --disable-pip-version-check kapture==1.1.12
"$work/venv/bin/python" - <<'PYTHON'
from importlib.metadata import version

import kapture
import numpy as np
import quaternion

print("kapture", version("kapture"))
STARTS, ENDS = 1_000_000, 1_100_000  # microseconds


def device_from_world(turn_deg, centre):
    turn = quaternion.from_rotation_vector([0, 0, np.radians(turn_deg)])
    return kapture.PoseTransform(turn, np.array(centre, float).reshape(3, 1)).inverse()


def off_m(distance_m, turn_deg):
    centre = [distance_m, 0, 0]
    path = kapture.Trajectories()
    path[STARTS, "camera"] = device_from_world(0, centre)
    path[ENDS, "camera"] = device_from_world(turn_deg, centre)
    halfway, most = (STARTS + ENDS) // 2, ENDS - STARTS
    forward = path.intermediate_pose(halfway, "camera", most).inverse()
    backward = path.inverse().intermediate_pose(halfway, "camera", most)
    turned_deg = np.degrees(np.linalg.norm(quaternion.as_rotation_vector(forward.r)))
    assert abs(turned_deg - turn_deg / 2) < 1e-6, "the rotation is another"
    return [float(np.linalg.norm(np.subtract(pose.t_raw, centre))) for pose in (forward, backward)]


for distance_m, turn_deg in ((10, 20), (100, 20), (100, 5)):
    plain, inverted = off_m(distance_m, turn_deg)
    print(f"{distance_m} m from the origin, turning by {turn_deg} degrees: {plain:.3f} m off, {inverted:.3f} m by the inverse")
    expected = distance_m * (1 - np.cos(np.radians(turn_deg / 2)))
    assert abs(plain - expected) < 1e-6, "the centre is elsewhere now"
    assert inverted < 1e-9, "the inverse is off, too"
print("as described")
PYTHON
