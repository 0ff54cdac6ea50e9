/** How probable it is that a pose found in a map is right, as `mambaloc/runtime/maps/acceptance.py` says it. No DOM. */

export const LEAST_PROBABILITY = 0.95;
export const MOST_DEVIATION = 0.12;
const CELLS = 4; // a side of the grid
const [CONSTANT, PER_CELLS, PER_DEVIATION, PER_TURN] = [-4.9, 3.48, -0.34, -1.01];
const [LEAST_DEVIATION, LEAST_TURN_DEG] = [1e-3, 0.1];
const [FOCAL_OFF, FOCAL_DEVIATIONS] = [0.03, 3];

/**
 * @param {number} cells of the grid that have a distinctive match that agrees with the pose.
 * @param {number} deviation of the position by all matches or by distinctive ones alone, whichever is larger, over the
 *     spread of the key frames.
 * @param {number} turn_deg from RANSAC's pose to the refined one.
 */
export function probabilityOf(cells, deviation, turn_deg) {
  if (!Number.isFinite(deviation)) return 0;
  const evidence =
    CONSTANT +
    PER_CELLS * Math.log(cells + 0.5) +
    PER_DEVIATION * Math.log(Math.max(deviation, LEAST_DEVIATION)) +
    PER_TURN * Math.log(turn_deg + LEAST_TURN_DEG);
  return 1 / (1 + Math.exp(-evidence));
}

/**
 * How many cells of the grid hold a place or more.
 * @param {{x: number, y: number}[]} places in shares of the image.
 */
export function occupiedCells(places) {
  return new Set(places.map(({ x, y }) => CELLS * Math.floor(CELLS * y) + Math.floor(CELLS * x))).size;
}

/** Whether matches contradict the given focal length. */
export function isAnotherFocalLength({ scale, deviation }) {
  return Math.abs(Math.log(scale)) > Math.max(FOCAL_OFF, FOCAL_DEVIATIONS * deviation);
}
