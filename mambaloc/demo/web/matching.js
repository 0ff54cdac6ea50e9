/** Matches between a picture's keypoints and a map's points. No DOM. */

const DESCRIPTOR = 128;

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
    let [best, first, second] = [-1, -1, -1];
    for (const point of visible) {
      const x = features.rays[2 * keypoint] - projected[2 * point];
      const y = features.rays[2 * keypoint + 1] - projected[2 * point + 1];
      if (x * x + y * y > radius * radius) continue;
      const similarity = product(features.descriptors, keypoint, descriptors, point);
      if (!(nearest.get(point)?.similarity >= similarity)) nearest.set(point, { keypoint, similarity });
      if (similarity > first) [best, first, second] = [point, similarity, first];
      else if (similarity > second) second = similarity;
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
  for (let i = row * DESCRIPTOR, j = column * DESCRIPTOR; i < (row + 1) * DESCRIPTOR; i++, j++) sum += a[i] * b[j];
  return sum;
}

/** Products of two keypoints with points, four at a time: each number that is loaded counts several times. */
function similarities(keypoints, [one, other], points, [toOne, toOther]) {
  const [a, b, step] = [one * DESCRIPTOR, other * DESCRIPTOR, DESCRIPTOR];
  const count = toOne.length;
  let point = 0;
  for (let at = 0; point + 4 <= count; point += 4, at += 4 * step) {
    let [a0, a1, a2, a3, b0, b1, b2, b3] = [0, 0, 0, 0, 0, 0, 0, 0];
    for (let i = 0; i < step; i++) {
      const x = keypoints[a + i];
      const y = keypoints[b + i];
      const [p, q, r, s] = [points[at + i], points[at + i + step], points[at + i + 2 * step], points[at + i + 3 * step]];
      a0 += x * p;
      a1 += x * q;
      a2 += x * r;
      a3 += x * s;
      b0 += y * p;
      b1 += y * q;
      b2 += y * r;
      b3 += y * s;
    }
    toOne.set([a0, a1, a2, a3], point);
    toOther.set([b0, b1, b2, b3], point);
  }
  for (; point < count; point++) {
    toOne[point] = product(keypoints, one, points, point);
    toOther[point] = product(keypoints, other, points, point);
  }
}

function bestTwo(similarity) {
  let [best, first, second] = [0, -1, -1];
  for (let i = 0; i < similarity.length; i++) {
    if (similarity[i] > first) {
      second = first;
      first = similarity[i];
      best = i;
    } else if (similarity[i] > second) second = similarity[i];
  }
  return { best, first, second };
}
