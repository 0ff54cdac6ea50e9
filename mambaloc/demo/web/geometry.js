/** Poses as numbers: `world_from_cam`, quaternions wxyz, OpenCV camera axes (x right, y down, z forward). No DOM. */

import { cross, dot, minus, unit } from "./vectors.js";

const degrees = (radians) => (radians * 180) / Math.PI;

/** One row of `trajectory.json` or `film.json`, as the localizer's answers look. */
export function poseOf([x, y, z, ...quaternion]) {
  return { position_m: [x, y, z], quaternion_wxyz: quaternion };
}

/** Turn a vector by a unit quaternion. */
export function rotated([w, x, y, z], vector) {
  const axis = [x, y, z];
  const twice = cross(axis, vector).map((value) => 2 * value);
  const turned = cross(axis, twice);
  return vector.map((value, i) => value + w * twice[i] + turned[i]);
}

/** The rotation of a unit quaternion, nine numbers row by row. */
export function matrixOf(quaternion) {
  const [x, y, z] = [[1, 0, 0], [0, 1, 0], [0, 0, 1]].map((axis) => rotated(quaternion, axis));
  return [x[0], y[0], z[0], x[1], y[1], z[1], x[2], y[2], z[2]];
}

/** The unit quaternion of a rotation, w of 0 or more. */
export function quaternionOf([xx, xy, xz, yx, yy, yz, zx, zy, zz]) {
  // Rows are the quaternion times each of its own numbers; the longest is the most exact.
  const rows = [
    [1 + xx + yy + zz, zy - yz, xz - zx, yx - xy],
    [zy - yz, 1 + xx - yy - zz, xy + yx, xz + zx],
    [xz - zx, xy + yx, 1 - xx + yy - zz, yz + zy],
    [yx - xy, xz + zx, yz + zy, 1 - xx - yy + zz],
  ];
  const longest = rows.reduce((best, row, i) => (row[i] > rows[best][best] ? i : best), 0);
  const length = Math.hypot(...rows[longest]) * (rows[longest][0] < 0 ? -1 : 1);
  return rows[longest].map((value) => value / length);
}

/**
 * The scene's "up", which nothing says: people hold cameras upright on the whole, so it is the mean of the -y axes.
 * @returns a unit vector, or null where there is no pose or they cancel out.
 */
export function upOf(poses) {
  const sum = [0, 0, 0];
  for (const { quaternion_wxyz } of poses) rotated(quaternion_wxyz, [0, -1, 0]).forEach((v, i) => (sum[i] += v));
  return Math.hypot(...sum) > 0.1 * poses.length ? unit(sum) : null;
}

/**
 * How a camera is held, in degrees, given "up".
 *
 * Heading: from the horizontal scene axis, anticlockwise seen from above. Pitch: above the horizon. Roll: right side
 * down.
 */
export function attitude(quaternion, up) {
  const [right, forward] = [rotated(quaternion, [1, 0, 0]), rotated(quaternion, [0, 0, 1])];
  const north = horizontalAxis(up);
  const level = unit(cross(forward, up));
  return {
    heading: (degrees(Math.atan2(dot(forward, cross(up, north)), dot(forward, north))) + 360) % 360,
    pitch: degrees(Math.asin(Math.min(1, Math.max(-1, dot(forward, up))))),
    roll: degrees(Math.atan2(-dot(right, cross(level, forward)), dot(right, level))),
  };
}

/** The scene axis that is least along "up", made horizontal. */
function horizontalAxis(up) {
  const least = up.reduce((best, value, i) => (Math.abs(value) < Math.abs(up[best]) - 0.5 ? i : best), 0);
  const axis = [0, 1, 2].map((i) => Number(i === least));
  return unit(minus(axis, up, dot(axis, up)));
}

/** The middle value; NaN of none. */
export function median(values) {
  const sorted = [...values].sort((a, b) => a - b);
  const half = sorted.length >> 1;
  return sorted.length % 2 ? sorted[half] : (sorted[half - 1] + sorted[half]) / 2;
}
