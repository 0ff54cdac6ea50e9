/**
 * The pose of a camera from points and where it sees them: RANSAC, and least squares, as
 * `mambaloc/runtime/maps/absolute_pose.py` does it. No DOM.
 *
 * A pose is `world_from_cam`: `rotation`, nine numbers row by row, and `position_m`, three. Points lie one after
 * another in a flat array, x, y, z in metres; rays x, y in the plane at depth 1.
 */

import { posesOfThree } from "./three_points.js";
import { cross, dot, inverse, solved, unit } from "./vectors.js";

const TRIALS = 1000;
const CONFIDENCE = 0.9999;
const STEPS = 10;
const LEAST_DEPTH = 1e-9;

/** Where points are seen, x, y of each; NaN where they are not in front. */
export function project({ rotation: r, position_m: [px, py, pz] }, points) {
  const seen = new Float64Array((points.length / 3) * 2);
  for (let from = 0, to = 0; from < points.length; from += 3, to += 2) {
    const [x, y, z] = [points[from] - px, points[from + 1] - py, points[from + 2] - pz];
    const depth = r[2] * x + r[5] * y + r[8] * z;
    seen[to] = depth > LEAST_DEPTH ? (r[0] * x + r[3] * y + r[6] * z) / depth : NaN;
    seen[to + 1] = depth > LEAST_DEPTH ? (r[1] * x + r[4] * y + r[7] * z) / depth : NaN;
  }
  return seen;
}

/** How far points are from their rays; infinite where they are not in front. */
export function residuals(pose, points, rays) {
  const seen = project(pose, points);
  const off = new Float64Array(rays.length / 2);
  for (let i = 0; i < off.length; i++) {
    const square = (seen[2 * i] - rays[2 * i]) ** 2 + (seen[2 * i + 1] - rays[2 * i + 1]) ** 2;
    off[i] = Number.isNaN(square) ? Infinity : Math.sqrt(square);
  }
  return off;
}

/**
 * Find the pose that most matches agree with, and fit it to those; null where there is none.
 * @param {number} near how far from its ray a point agrees.
 * @param {number} seed of what is drawn.
 */
export function ransacPose(points, rays, near, seed) {
  const count = rays.length / 2;
  if (count < 4) return null;
  const random = randomNumbers(seed);
  let [best, least, enough] = [null, Infinity, TRIALS];
  for (let trial = 0; trial < enough; trial++) {
    const three = drawn(count, random);
    const directions = three.map((i) => unit([rays[2 * i], rays[2 * i + 1], 1]));
    for (const pose of posesOfThree(three.map((i) => points.slice(3 * i, 3 * i + 3)), directions)) {
      const off = residuals(pose, points, rays);
      const cost = off.reduce((sum, each) => sum + Math.min(each / near, 1) ** 2, 0);
      if (cost >= least) continue;
      [best, least] = [pose, cost];
      const share = off.reduce((sum, each) => sum + (each <= near), 0) / count;
      enough = Math.min(TRIALS, Math.log(1 - CONFIDENCE) / Math.log(1 - Math.min(share ** 3, 0.999)));
    }
  }
  if (!best) return null;
  const off = residuals(best, points, rays);
  const agreeing = [...off.keys()].filter((i) => off[i] <= near);
  if (agreeing.length < 4) return null;
  return refinePose(best, selected(points, agreeing, 3), selected(rays, agreeing, 2), near).pose;
}

/** Rows of a flat array of so many columns. */
export function selected(values, rows, columns) {
  const chosen = new Float64Array(rows.length * columns);
  rows.forEach((row, i) => chosen.set(values.subarray(row * columns, (row + 1) * columns), i * columns));
  return chosen;
}

function drawn(count, random) {
  const three = [];
  while (three.length < 3) {
    const one = Math.floor(random() * count);
    if (!three.includes(one)) three.push(one);
  }
  return three;
}

/** Numbers from 0 to 1, the same for a seed wherever this runs (Mulberry32 of Tommy Ettinger, public domain). */
function randomNumbers(seed) {
  let state = seed;
  return () => {
    state = (state + 0x6d2b79f5) | 0;
    let mixed = Math.imul(state ^ (state >>> 15), state | 1);
    mixed = (mixed + Math.imul(mixed ^ (mixed >>> 7), mixed | 61)) ^ mixed;
    return ((mixed ^ (mixed >>> 14)) >>> 0) / 2 ** 32;
  };
}

/**
 * Least squares of all matches with Cauchy's weights, by Levenberg-Marquardt.
 * @param start a pose from which the points lie in front.
 * @param {number} near a match that is off by half of it has half the weight.
 * @returns {{pose: object, covariance: number[][]|null}} of the position in metres, then of the rotation in radians
 *   about the world's axes; null where the matches leave something open.
 */
export function refinePose(start, points, rays, near) {
  let [pose, damping, now] = [start, 1e-4, normalEquations(start, points, rays, near)];
  for (let step = 0; step < STEPS; step++) {
    const damped = now.normal.map((row, i) => row.map((value, j) => value + (i === j ? damping * value + 1e-12 : 0)));
    const change = solved(damped, now.right.map((value) => [value]));
    if (!change) break;
    const changed = moved(pose, change.flat());
    const next = normalEquations(changed, points, rays, near);
    if (!(next.cost <= now.cost)) {
      damping *= 10;
      continue;
    }
    const hasConverged = now.cost - next.cost <= 1e-6 * now.cost;
    [pose, damping, now] = [changed, damping / 10, next];
    if (hasConverged) break;
  }
  const covariance = inverse(now.normal)?.map((row) => row.map((value) => value * now.spread)) ?? null;
  return { pose, covariance };
}

/** Move a pose by metres, and turn it by radians about the world's axes. */
export function moved({ rotation, position_m }, [dx, dy, dz, ...turn]) {
  const angle = Math.hypot(...turn);
  const axis = unit(turn);
  const turned = [0, 1, 2].map((column) => {
    const along = [rotation[column], rotation[3 + column], rotation[6 + column]];
    const across = cross(axis, along);
    const twice = cross(axis, across);
    return along.map((value, i) => value + Math.sin(angle) * across[i] + (1 - Math.cos(angle)) * twice[i]);
  });
  return {
    rotation: [0, 1, 2].flatMap((row) => turned.map((column) => column[row])),
    position_m: [position_m[0] + dx, position_m[1] + dy, position_m[2] + dz],
  };
}

/** Cost, `J^T W J`, `-J^T W r`, and the weighted variance of the residuals `r`. */
function normalEquations({ rotation: r, position_m: [px, py, pz] }, points, rays, near) {
  const normal = Array.from({ length: 6 }, () => new Array(6).fill(0));
  const right = new Array(6).fill(0);
  let [cost, squares] = [0, 0];
  for (let i = 0, j = 0; i < rays.length; i += 2, j += 3) {
    const towards = [points[j] - px, points[j + 1] - py, points[j + 2] - pz];
    const [x, y, depth] = [0, 1, 2].map((axis) => dot([r[axis], r[3 + axis], r[6 + axis]], towards));
    if (depth <= LEAST_DEPTH) return { cost: Infinity, normal, right, spread: Infinity };
    const seen = [x / depth, y / depth];
    const off = seen.map((value, axis) => ((value - rays[i + axis]) * 2) / near);
    const square = off[0] ** 2 + off[1] ** 2;
    const weight = 1 / (1 + square);
    cost += Math.log1p(square);
    squares += weight * square;
    for (let axis = 0; axis < 2; axis++) {
      // d off / d point; a turn about the world's axes moves a point by towards x turn.
      const slope = [0, 3, 6].map((row) => ((r[row + axis] - seen[axis] * r[row + 2]) * 2) / near / depth);
      const jacobian = [-slope[0], -slope[1], -slope[2], ...cross(slope, towards)];
      for (let row = 0; row < 6; row++) {
        right[row] -= weight * jacobian[row] * off[axis];
        for (let column = 0; column < 6; column++) normal[row][column] += weight * jacobian[row] * jacobian[column];
      }
    }
  }
  return { cost, normal, right, spread: squares / Math.max(rays.length - 6, 1) };
}
