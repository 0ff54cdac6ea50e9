/** How far cameras are from each other, as `mambaloc/runtime/maps/viewpoints.py` counts it. No DOM. */

import { scaled } from "./vectors.js";

const TURN = (25 * Math.PI) / 180; // radians that count as much as a move by the scene's unit

/** Root mean square of how far cameras are from their mean: the scene's own unit of length. */
export function spreadOf(poses) {
  const middle = [0, 1, 2].map((axis) => poses.reduce((sum, pose) => sum + pose.position_m[axis], 0) / poses.length);
  const squares = poses.map((pose) => squareBetween(pose.position_m, middle));
  return Math.sqrt(squares.reduce((a, b) => a + b, 0) / poses.length);
}

/** A camera as six numbers, of its position and direction of view. */
export function viewpoint({ rotation, position_m }, unit_m) {
  const forward = [rotation[2], rotation[5], rotation[8]];
  return [...scaled(position_m, 1 / Math.max(unit_m, 1e-12)), ...scaled(forward, 1 / TURN)];
}

/** The squared distance of two lists of numbers. */
export function squareBetween(a, b) {
  return a.reduce((sum, value, i) => sum + (value - b[i]) ** 2, 0);
}
