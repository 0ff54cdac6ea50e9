/** Poses as numbers: `world_from_cam`, quaternions wxyz, OpenCV camera axes (x right, y down, z forward). No DOM. */

const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const minus = (a, b, scale = 1) => a.map((value, i) => value - scale * b[i]);
const unit = (a) => a.map((value) => value / (Math.hypot(...a) || 1));
const degrees = (radians) => (radians * 180) / Math.PI;

/** One row of `trajectory.json` or `film.json`, as the localiser's answers look. */
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
