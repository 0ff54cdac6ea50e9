/** Matches between a picture's keypoints and a map's points. No DOM. */

import { LENGTH } from "./descriptors.js";

/**
 * Match keypoints with so many points at once, each that is clearly nearer to its best than to its second best.
 * @param {{count: number, descriptors: Float32Array}} features of the picture.
 * @param {Float32Array} descriptors of the points.
 * @param {number} count of the points, from the first.
 * @param {number} ratio of both distances, below which a match counts.
 * @returns {{keypoints: number[], points: number[]}}
 */
export function matchAll(features, descriptors, count, ratio) {
  const matches = { keypoints: [], points: [] };
  const similarity = [new Float32Array(count), new Float32Array(count)];
  for (let keypoint = 0; keypoint < features.count; keypoint += 2) {
    const other = Math.min(keypoint + 1, features.count - 1);
    similarities(features.descriptors, [keypoint, other], descriptors, similarity);
    for (let i = 0; i <= other - keypoint; i++) {
      const { best, first, second } = bestTwo(similarity[i]);
      if (count < 2 || !(distance(first) < ratio * distance(second))) continue;
      matches.keypoints.push(keypoint + i);
      matches.points.push(best);
    }
  }
  return matches;
}

/**
 * Match keypoints with the points projected near them; each must be the other's best.
 * @param {{count: number, rays: Float64Array, descriptors: Float32Array}} features of the picture.
 * @param {number[]} visible points that may be seen.
 * @param {Float64Array} projected where every point of the map is, x, y in the plane at depth 1.
 * @param {Float32Array} descriptors of every point.
 * @param {{radius: number, ratio: number, farthest: number}} limits in that plane, of both distances, and of the first.
 */
export function matchNearby(features, visible, projected, descriptors, { radius, ratio, farthest }) {
  const matches = { keypoints: [], points: [] };
  if (visible.length < 2) return matches;
  const nearest = new Map(); // of each point, its keypoint and their similarity
  const found = [];
  for (let keypoint = 0; keypoint < features.count; keypoint++) {
    let best = -1;
    let first = -1;
    let second = -1;
    for (const point of visible) {
      const x = features.rays[2 * keypoint] - projected[2 * point];
      const y = features.rays[2 * keypoint + 1] - projected[2 * point + 1];
      if (x * x + y * y > radius * radius) continue;
      const similarity = product(features.descriptors, keypoint, descriptors, point);
      if (!(nearest.get(point)?.similarity >= similarity)) nearest.set(point, { keypoint, similarity });
      if (similarity > first) {
        second = first;
        first = similarity;
        best = point;
      } else if (similarity > second) second = similarity;
    }
    if (best >= 0 && distance(first) < Math.min(farthest, ratio * distance(second))) found.push([keypoint, best]);
  }
  for (const [keypoint, point] of found) {
    if (nearest.get(point).keypoint !== keypoint) continue;
    matches.keypoints.push(keypoint);
    matches.points.push(point);
  }
  return matches;
}

/** Euclidean distance of unit descriptors from their product. */
function distance(similarity) {
  return Math.sqrt(Math.max(2 - 2 * similarity, 0));
}

function product(a, row, b, column) {
  let sum = 0;
  for (let i = row * LENGTH, j = column * LENGTH; i < (row + 1) * LENGTH; i++, j++) sum += a[i] * b[j];
  return sum;
}

/** Products of two keypoints with points, four at a time: each number that is loaded counts several times. */
function similarities(keypoints, [one, other], points, [toOne, toOther]) {
  const a = one * LENGTH;
  const b = other * LENGTH;
  let point = 0;
  for (; point + 4 <= toOne.length; point += 4) {
    const p = point * LENGTH;
    const q = p + LENGTH;
    const r = q + LENGTH;
    const s = r + LENGTH;
    let ap = 0;
    let aq = 0;
    let ar = 0;
    let as = 0;
    let bp = 0;
    let bq = 0;
    let br = 0;
    let bs = 0;
    for (let i = 0; i < LENGTH; i++) {
      const ofA = keypoints[a + i];
      const ofB = keypoints[b + i];
      ap += ofA * points[p + i];
      aq += ofA * points[q + i];
      ar += ofA * points[r + i];
      as += ofA * points[s + i];
      bp += ofB * points[p + i];
      bq += ofB * points[q + i];
      br += ofB * points[r + i];
      bs += ofB * points[s + i];
    }
    toOne[point] = ap;
    toOne[point + 1] = aq;
    toOne[point + 2] = ar;
    toOne[point + 3] = as;
    toOther[point] = bp;
    toOther[point + 1] = bq;
    toOther[point + 2] = br;
    toOther[point + 3] = bs;
  }
  for (; point < toOne.length; point++) {
    toOne[point] = product(keypoints, one, points, point);
    toOther[point] = product(keypoints, other, points, point);
  }
}

function bestTwo(similarity) {
  let best = 0;
  let first = -1;
  let second = -1;
  for (let i = 0; i < similarity.length; i++) {
    if (similarity[i] > first) {
      second = first;
      first = similarity[i];
      best = i;
    } else if (similarity[i] > second) second = similarity[i];
  }
  return { best, first, second };
}
