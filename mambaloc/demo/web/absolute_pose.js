/**
 * The pose of a camera from points and where it sees them: RANSAC, and least squares, as
 * `mambaloc/runtime/maps/absolute_pose.py` does it. No DOM.
 *
 * A pose is `world_from_cam`: `rotation`, nine numbers row by row, and `position_m`, three. Points lie one after
 * another in a flat array, x, y, z in metres; rays x, y in the plane at depth 1.
 */

import { posesOfThree } from "./three_points.js";
import { cross, inverse, product, solved, unit } from "./vectors.js";

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
 *   about the world's axes: Huber's sandwich; null where the matches leave something open.
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
  return { pose, covariance: covarianceOf(pose, points, rays, near) };
}

/**
 * How much longer than given the focal length is: a Gauss-Newton step of pose and focal length together.
 * @returns {{scale: number, deviation: number}} the deviation is infinite where nothing says.
 */
export function focalScale(pose, points, rays, near) {
  const linear = linearised(pose, points, rays, near);
  if (!linear) return { scale: 1, deviation: Infinity };
  const { off, jacobian, seen, weights } = linear;
  const [normal, right] = [zeros(7, 7), new Float64Array(7)];
  let squares = 0;
  for (let i = 0; i < off.length; i++) {
    const row = [...jacobian.subarray(6 * i, 6 * i + 6), (seen[i] * 2) / near];
    addOuter(normal, row, weights[i >> 1]);
    row.forEach((value, j) => (right[j] -= weights[i >> 1] * value * off[i]));
    squares += weights[i >> 1] * off[i] ** 2;
  }
  const found = inverse(normal);
  const variance = found ? (found[6][6] * squares) / Math.max(off.length - 7, 1) : 0;
  if (!(variance > 0)) return { scale: 1, deviation: Infinity };
  const step = found[6].reduce((sum, value, i) => sum + value * right[i], 0);
  return { scale: Math.exp(step), deviation: Math.sqrt(variance) };
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

/**
 * Residuals in halves of `near`, two a match; their slopes, six of each; where points are seen; and Cauchy's weights of
 * matches. Null where a point is not in front.
 */
function linearised({ rotation: r, position_m: [px, py, pz] }, points, rays, near) {
  const count = rays.length / 2;
  const [off, seen, jacobian, weights] = [2, 2, 12, 1].map((each) => new Float64Array(each * count));
  for (let i = 0; i < count; i++) {
    const [x, y, z] = [points[3 * i] - px, points[3 * i + 1] - py, points[3 * i + 2] - pz];
    const depth = r[2] * x + r[5] * y + r[8] * z;
    if (depth <= LEAST_DEPTH) return null;
    for (let axis = 0; axis < 2; axis++) {
      const at = 2 * i + axis;
      seen[at] = (r[axis] * x + r[3 + axis] * y + r[6 + axis] * z) / depth;
      off[at] = ((seen[at] - rays[at]) * 2) / near;
      // d off / d point; a turn about the world's axes moves a point by towards x turn.
      const factor = 2 / near / depth;
      const a = (r[axis] - seen[at] * r[2]) * factor;
      const b = (r[3 + axis] - seen[at] * r[5]) * factor;
      const c = (r[6 + axis] - seen[at] * r[8]) * factor;
      jacobian.set([-a, -b, -c, b * z - c * y, c * x - a * z, a * y - b * x], 6 * at);
    }
    weights[i] = 1 / (1 + off[2 * i] ** 2 + off[2 * i + 1] ** 2);
  }
  return { off, jacobian, seen, weights };
}

/** Cost, `J^T W J` and `-J^T W r` of residuals `r`. */
function normalEquations(pose, points, rays, near) {
  const [normal, right] = [zeros(6, 6), new Array(6).fill(0)];
  const linear = linearised(pose, points, rays, near);
  if (!linear) return { cost: Infinity, normal, right };
  const { off, jacobian, weights } = linear;
  for (let i = 0; i < off.length; i++) {
    const [row, weight] = [jacobian.subarray(6 * i, 6 * i + 6), weights[i >> 1]];
    addOuter(normal, row, weight);
    for (let j = 0; j < 6; j++) right[j] -= weight * row[j] * off[i];
  }
  return { cost: weights.reduce((sum, weight) => sum - Math.log(weight), 0), normal, right };
}

/** `H^-1 (sum of g g^T) H^-1` of the cost's Hessian and each match's gradient; null where `H` is singular. */
function covarianceOf(pose, points, rays, near) {
  const linear = linearised(pose, points, rays, near);
  if (!linear) return null;
  const { off, jacobian, weights } = linear;
  const [hessian, squares, gradient] = [zeros(6, 6), zeros(6, 6), new Float64Array(6)];
  for (let i = 0; i < off.length; i += 2) {
    const weight = weights[i / 2];
    const [one, other] = [0, 6].map((from) => jacobian.subarray(6 * i + from, 6 * i + from + 6));
    for (let j = 0; j < 6; j++) gradient[j] = weight * (one[j] * off[i] + other[j] * off[i + 1]);
    addOuter(hessian, one, weight);
    addOuter(hessian, other, weight);
    addOuter(hessian, gradient, -2);
    addOuter(squares, gradient, off.length / Math.max(off.length - 6, 1));
  }
  const found = inverse(hessian);
  return found && product(product(found, squares), found);
}

const zeros = (rows, columns) => Array.from({ length: rows }, () => new Array(columns).fill(0));

/** Add the outer product of a row with itself, times a weight. */
function addOuter(matrix, row, weight) {
  for (let i = 0; i < row.length; i++) {
    for (let j = 0; j < row.length; j++) matrix[i][j] += weight * row[i] * row[j];
  }
}
