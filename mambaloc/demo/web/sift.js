/**
 * SIFT (Lowe 2004) with RootSIFT descriptors (Arandjelović and Zisserman 2012). No DOM.
 *
 * Its keypoints are those of OpenCV's `SIFT_create(1000, contrastThreshold=0.02, enable_precise_upscale=True)`, by
 * which maps are built, so that one map serves Python and the page; tests/demo/test_map_in_node.py compares them.
 */

import { LENGTH, describe, orientationsOf } from "./descriptors.js";
import { BORDER, LAYERS, SIGMA, octavesOf } from "./scale_space.js";
import { cross, dot } from "./vectors.js";

const MOST_KEYPOINTS = 1000;
const CONTRAST = 0.02;
const EDGE = 10; // largest ratio of the principal curvatures
const FIT_STEPS = 5;

/**
 * Find the keypoints of a grey image.
 * @param {{values: ArrayLike<number>, width: number, height: number}} grey in 0..255.
 * @returns {{count: number, pixels: Float64Array, descriptors: Float32Array}} x, y of each keypoint, where the centre
 *   of the top left pixel is (0, 0), and 128 numbers of unit length.
 */
export function detectFeatures(grey) {
  const keypoints = [];
  for (const octave of octavesOf(grey)) {
    for (const extremum of extremaOf(octave)) {
      for (const angle of orientationsOf(extremum)) keypoints.push({ ...extremum, angle });
    }
  }
  const kept = strongest(keypoints);
  const pixels = new Float64Array(2 * kept.length);
  const descriptors = new Float32Array(LENGTH * kept.length);
  kept.forEach((keypoint, i) => {
    pixels[2 * i] = keypoint.x;
    pixels[2 * i + 1] = keypoint.y;
    describe(keypoint, descriptors.subarray(LENGTH * i, LENGTH * (i + 1)));
  });
  return { count: kept.length, pixels, descriptors };
}

/** The strongest keypoints; what is as strong as the last one stays, too. */
function strongest(keypoints) {
  const sorted = keypoints.sort((a, b) => b.strength - a.strength);
  const least = sorted[MOST_KEYPOINTS - 1]?.strength ?? 0;
  return sorted.filter(({ strength }) => strength >= least);
}

/** Extrema of an octave's differences in position and scale. */
function extremaOf(octave) {
  const found = new Map(); // by the pixel where the fit ends: two may end in one
  const { width, height } = octave.differences[0];
  for (let layer = 1; layer <= LAYERS; layer++) {
    const planes = [0, -1, 1].map((step) => octave.differences[layer + step].values);
    for (let y = BORDER; y < height - BORDER; y++) {
      for (let x = BORDER; x < width - BORDER; x++) {
        if (!isExtremum(planes, y * width + x, width)) continue;
        const extremum = fitted(octave, layer, x, y);
        if (extremum) found.set(extremum.key, extremum);
      }
    }
  }
  return found.values();
}

/** Whether none of the 26 neighbours is larger, or none smaller. */
function isExtremum(planes, at, width) {
  const value = planes[0][at];
  const sign = Math.sign(value);
  if (!sign) return false;
  for (const plane of planes) {
    for (let row = at - width; row <= at + width; row += width) {
      if (sign * plane[row - 1] > sign * value) return false;
      if (sign * plane[row] > sign * value) return false;
      if (sign * plane[row + 1] > sign * value) return false;
    }
  }
  return true;
}

/** Fit a parabola about an extremum, and move to the pixel where its peak lies; null where it is weak or an edge. */
function fitted(octave, layer, x, y) {
  const { width, height } = octave.differences[0];
  for (let step = 0; step < FIT_STEPS; step++) {
    const [gradient, hessian, value] = derivatives(octave.differences, layer, y * width + x, width);
    const offset = solved3(hessian, gradient)?.map((each) => -each);
    if (!offset) return null;
    if (offset.every((each) => Math.abs(each) < 0.5)) {
      return judged(octave, [x, y, layer], offset, gradient, hessian, value);
    }
    [x, y, layer] = [x, y, layer].map((each, i) => each + Math.round(offset[i]));
    const inside = x >= BORDER && x < width - BORDER && y >= BORDER && y < height - BORDER;
    if (!inside || !(layer >= 1 && layer <= LAYERS)) return null;
  }
  return null;
}

/** A keypoint, unless its peak is weak or it lies on an edge: then null. */
function judged({ pixel, layers }, [column, row, layer], [dx, dy, dLayer], gradient, hessian, value) {
  const peak = value + 0.5 * (gradient[0] * dx + gradient[1] * dy + gradient[2] * dLayer);
  const [[xx, xy], [, yy]] = hessian;
  const determinant = xx * yy - xy * xy;
  if (Math.abs(peak) * LAYERS < CONTRAST || (xx + yy) ** 2 * EDGE >= (EDGE + 1) ** 2 * determinant) return null;
  return {
    key: (layer * layers[0].height + row) * layers[0].width + column,
    image: layers[layer],
    column,
    row,
    scale: SIGMA * 2 ** ((layer + dLayer) / LAYERS),
    x: (column + dx) * pixel,
    y: (row + dy) * pixel,
    strength: Math.abs(peak),
  };
}

/** Central differences along x, y and the layers of images in 0..1. */
function derivatives(differences, layer, at, width) {
  const [below, here, above] = [-1, 0, 1].map((step) => differences[layer + step].values);
  const first = [here[at + 1] - here[at - 1], here[at + width] - here[at - width], above[at] - below[at]];
  const twice = 2 * here[at];
  const xx = here[at + 1] + here[at - 1] - twice;
  const yy = here[at + width] + here[at - width] - twice;
  const ss = above[at] + below[at] - twice;
  const xy = (here[at + width + 1] - here[at + width - 1] - here[at - width + 1] + here[at - width - 1]) / 4;
  const xs = (above[at + 1] - above[at - 1] - below[at + 1] + below[at - 1]) / 4;
  const ys = (above[at + width] - above[at - width] - below[at + width] + below[at - width]) / 4;
  const hessian = [[xx, xy, xs], [xy, yy, ys], [xs, ys, ss]];
  return [first.map((each) => each / 510), hessian.map((line) => line.map((each) => each / 255)), here[at] / 255];
}

/** Cramer's rule; null where there is no answer. */
function solved3([a, b, c], right) {
  const determinant = dot(a, cross(b, c)); // symmetric: rows are columns
  if (!determinant) return null;
  return [dot(right, cross(b, c)), dot(a, cross(right, c)), dot(a, cross(b, right))].map((each) => each / determinant);
}
