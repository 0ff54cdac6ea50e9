/** Matches between an image's keypoints and a map's points. No DOM. */

import { LENGTH } from "./descriptors.js";

const HEAD = 24; // numbers of a turned descriptor that most decisions need

/** Matches keypoints with many points at once. */
export class Matcher {
  #order;
  #points;
  #atOnce;

  /**
   * @param {Float32Array} descriptors of the points.
   * @param {number} atOnce so many of the first are matched at once.
   */
  constructor(descriptors, atOnce) {
    const spectra = spectraOf(descriptors);
    const energy = new Float64Array(LENGTH);
    spectra.forEach((value, i) => (energy[i % LENGTH] += value * value));
    this.#order = [...energy.keys()].sort((a, b) => energy[b] - energy[a]);
    this.#points = split(spectra, this.#order);
    this.#atOnce = Math.min(atOnce, this.#points.rests.length);
  }

  /** Add the turned descriptors to an image's features, for the methods below. */
  turned(features) {
    return { ...features, turned: split(spectraOf(features.descriptors), this.#order) };
  }

  /**
   * Rows of matches that are distinctive: no point in view is more similar to the keypoint than its own.
   * @param features of `turned`.
   * @param {{keypoints: number[], points: number[], visible: number[]}} matches of {@link matchNearby}.
   */
  distinctive({ turned: { heads, tails, rests } }, { keypoints, points, visible }) {
    const theirs = this.#points;
    const head = (keypoint, point) => product(heads, keypoint, theirs.heads, point, HEAD);
    const tail = (keypoint, point) => product(tails, keypoint, theirs.tails, point, LENGTH - HEAD);
    return [...keypoints.keys()].filter((row) => {
      const keypoint = keypoints[row];
      const own = head(keypoint, points[row]) + tail(keypoint, points[row]);
      return visible.every((point) => {
        const least = head(keypoint, point);
        return least + rests[keypoint] * theirs.rests[point] <= own || least + tail(keypoint, point) <= own;
      });
    });
  }

  /**
   * Match each keypoint that is clearly nearer to its best point than to its second best.
   *
   * Most points are ruled out by the first numbers of the turned descriptors: what the others can add to a product is
   * at most the product of their lengths. So this finds what all numbers would.
   * @param {{count: number, turned: object}} features of `turned`.
   * @param {number} ratio of both distances, below which a match counts.
   * @returns {{keypoints: number[], points: number[]}}
   */
  match(features, ratio) {
    const matches = { keypoints: [], points: [] };
    const { heads, tails, rests } = features.turned;
    const count = this.#atOnce;
    const sums = [new Float32Array(count), new Float32Array(count)];
    for (let keypoint = 0; keypoint < features.count; keypoint += 2) {
      const other = Math.min(keypoint + 1, features.count - 1);
      productsOfTwo(heads, keypoint, other, this.#points.heads, sums);
      for (let row = keypoint; row <= other; row++) {
        const { best, first, second } = this.#bestTwo(sums[row - keypoint], tails, row, rests[row]);
        if (count < 2 || !(distance(first) < ratio * distance(second))) continue;
        matches.keypoints.push(row);
        matches.points.push(best);
      }
    }
    return matches;
  }

  #bestTwo(sums, tails, row, rest) {
    const points = this.#points;
    let best = 0;
    let first = -1;
    let second = -1;
    for (let i = 0; i < sums.length; i++) {
      if (sums[i] + rest * points.rests[i] <= second) continue;
      const similarity = sums[i] + product(tails, row, points.tails, i, LENGTH - HEAD);
      if (similarity > first) {
        second = first;
        first = similarity;
        best = i;
      } else if (similarity > second) second = similarity;
    }
    return { best, first, second };
  }
}

/**
 * Match keypoints with the points projected near them; each must be the other's best.
 * @param {{count: number, rays: Float64Array, descriptors: Float32Array}} features of the image.
 * @param {number[]} visible points that may be seen.
 * @param {Float64Array} projected where every point of the map is, x, y in the plane at depth 1.
 * @param {Float32Array} descriptors of every point.
 * @param {{radius: number, ratio: number, farthest: number}} limits in that plane, of both distances, and of the first.
 * @returns {{keypoints: number[], points: number[], visible: number[]}}
 */
export function matchNearby(features, visible, projected, descriptors, { radius, ratio, farthest }) {
  const matches = { keypoints: [], points: [], visible };
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
      const similarity = product(features.descriptors, keypoint, descriptors, point, LENGTH);
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

function product(a, row, b, column, length) {
  let sum = 0;
  for (let i = row * length, j = column * length; i < (row + 1) * length; i++, j++) sum += a[i] * b[j];
  return sum;
}

/** Walsh-Hadamard transforms: descriptors turned, so that a few numbers hold most of each. */
function spectraOf(descriptors) {
  const spectra = Float32Array.from(descriptors, (value) => value / Math.sqrt(LENGTH));
  for (let half = 1; half < LENGTH; half *= 2) {
    for (let i = 0; i < spectra.length; i++) {
      if (i & half) continue;
      const [a, b] = [spectra[i], spectra[i + half]];
      spectra[i] = a + b;
      spectra[i + half] = a - b;
    }
  }
  return spectra;
}

/** The first numbers of each descriptor in an order, the others, and the length of these. */
function split(spectra, order) {
  const count = spectra.length / LENGTH;
  const [heads, tails] = [new Float32Array(count * HEAD), new Float32Array(count * (LENGTH - HEAD))];
  const rests = new Float32Array(count);
  for (let row = 0, head = 0, tail = 0; row < count; row++) {
    let square = 0;
    order.forEach((column, i) => {
      const value = spectra[row * LENGTH + column];
      if (i < HEAD) heads[head++] = value;
      else square += (tails[tail++] = value) ** 2;
    });
    rests[row] = Math.sqrt(square) * (1 + 1e-5); // rounding rules nothing out
  }
  return { heads, tails, rests };
}

/** Products of two keypoints with points, four at a time: each number that is loaded counts several times. */
function productsOfTwo(keypoints, one, other, points, [toOne, toOther]) {
  const a = one * HEAD;
  const b = other * HEAD;
  let point = 0;
  for (; point + 4 <= toOne.length; point += 4) {
    const p = point * HEAD;
    const q = p + HEAD;
    const r = q + HEAD;
    const s = r + HEAD;
    let ap = 0;
    let aq = 0;
    let ar = 0;
    let as = 0;
    let bp = 0;
    let bq = 0;
    let br = 0;
    let bs = 0;
    for (let i = 0; i < HEAD; i++) {
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
    toOne[point] = product(keypoints, one, points, point, HEAD);
    toOther[point] = product(keypoints, other, points, point, HEAD);
  }
}
