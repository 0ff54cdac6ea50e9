/** Orientations and descriptors of keypoints (Lowe 2004, sections 5 and 6), as OpenCV computes them. No DOM. */

export const LENGTH = 128; // of a descriptor
const BINS = 36; // of the histogram of orientations
const PEAK = 0.8; // of its highest bin, from which another one is an orientation too
const CELLS = 4; // a side of the descriptor
const DIRECTIONS = 8; // a cell
const CELL_SIGMAS = 3; // side of a cell in the keypoint's scale
const LARGEST_SHARE = 0.2; // of a descriptor's length, that one number may have
const TURN = 2 * Math.PI;
const ARC = [0.99986633, -0.33030475, 0.18015914, -0.08515611, 0.02084499]; // best odd polynomial for the arctangent

/** The directions, from x towards y in radians, of most gradients about an extremum. */
export function orientationsOf({ image, column, row, scale }) {
  const { values, width, height } = image;
  const histogram = new Float64Array(BINS);
  const reach = Math.round(4.5 * scale);
  const bell = bellOf(1.5 * scale, reach);
  for (let y = Math.max(row - reach, 1); y <= Math.min(row + reach, height - 2); y++) {
    const weight = bell[Math.abs(y - row)];
    for (let x = Math.max(column - reach, 1); x <= Math.min(column + reach, width - 2); x++) {
      const at = y * width + x;
      const dx = values[at + 1] - values[at - 1];
      const dy = values[at + width] - values[at - width];
      const bin = Math.round(angleOf(dx, dy) * (BINS / TURN)) % BINS;
      histogram[bin] += weight * bell[Math.abs(x - column)] * Math.sqrt(dx * dx + dy * dy);
    }
  }
  return peaksOf(smoothed(histogram)).map((bin) => ((bin + BINS) % BINS) * (TURN / BINS));
}

/** A Gaussian at whole pixels from its middle. */
function bellOf(sigma, reach) {
  return Float64Array.from({ length: reach + 1 }, (_, i) => Math.exp((-i * i) / (2 * sigma * sigma)));
}

/** From x towards y in radians, 0 to a turn; within 0.00002, and several times as fast as `Math.atan2`. */
function angleOf(x, y) {
  const [across, along] = [Math.abs(x), Math.abs(y)];
  const slope = Math.min(across, along) / (Math.max(across, along) || 1);
  const square = slope * slope;
  let angle = slope * (ARC[0] + square * (ARC[1] + square * (ARC[2] + square * (ARC[3] + square * ARC[4]))));
  if (along > across) angle = TURN / 4 - angle;
  if (x < 0) angle = TURN / 2 - angle;
  return y < 0 ? TURN - angle : angle;
}

function smoothed(histogram) {
  const at = (i) => histogram[(i + BINS) % BINS];
  return histogram.map((value, i) => (6 * value + 4 * (at(i - 1) + at(i + 1)) + at(i - 2) + at(i + 2)) / 16);
}

function peaksOf(histogram) {
  const least = PEAK * Math.max(...histogram);
  const peaks = [];
  histogram.forEach((value, i) => {
    const [left, right] = [histogram[(i + BINS - 1) % BINS], histogram[(i + 1) % BINS]];
    if (value <= left || value <= right || value < least) return;
    peaks.push(i + (0.5 * (left - right)) / (left - 2 * value + right));
  });
  return peaks;
}

/**
 * Write the RootSIFT descriptor of a keypoint: histograms of directions in 4x4 cells turned to its own, each gradient
 * shared among the nearest cells and directions.
 */
export function describe({ image, column, row, scale, angle }, to) {
  const { values, width, height } = image;
  const side = CELL_SIGMAS * scale;
  const reach = Math.min(Math.round((side * Math.SQRT2 * (CELLS + 1)) / 2), Math.trunc(Math.hypot(width, height)));
  const bell = bellOf((side * CELLS) / 2, reach);
  const [cos, sin] = [Math.cos(angle) / side, Math.sin(angle) / side];
  const middle = CELLS / 2 + 0.5; // counted from a margin of one cell
  const histogram = new Float64Array((CELLS + 2) * (CELLS + 2) * DIRECTIONS);
  for (let y = Math.max(row - reach, 1); y <= Math.min(row + reach, height - 2); y++) {
    for (let x = Math.max(column - reach, 1); x <= Math.min(column + reach, width - 2); x++) {
      const cellX = cos * (x - column) + sin * (y - row) + middle;
      const cellY = cos * (y - row) - sin * (x - column) + middle;
      if (!(cellX > 0 && cellX < CELLS + 1 && cellY > 0 && cellY < CELLS + 1)) continue;
      const at = y * width + x;
      const dx = values[at + 1] - values[at - 1];
      const dy = values[at + width] - values[at - width];
      const weight = bell[Math.abs(x - column)] * bell[Math.abs(y - row)] * Math.sqrt(dx * dx + dy * dy);
      const turned = (angle - angleOf(dx, dy)) * (DIRECTIONS / TURN);
      share(histogram, cellX, cellY, turned < 0 ? turned + DIRECTIONS : turned, weight);
    }
  }
  for (let y = 0, i = 0; y < CELLS; y++) {
    const from = ((y + 1) * (CELLS + 2) + 1) * DIRECTIONS;
    for (let k = 0; k < CELLS * DIRECTIONS; k++) to[i++] = histogram[from + k];
  }
  rooted(to);
}

/** Share a weight among two rows, two columns and two directions. */
function share(histogram, cellX, cellY, direction, weight) {
  const x = Math.floor(cellX);
  const y = Math.floor(cellY);
  const here = Math.floor(direction) % DIRECTIONS;
  const next = (here + 1) % DIRECTIONS;
  const last = direction - Math.floor(direction);
  const lower = weight * (cellY - y);
  for (let row = 0; row < 2; row++) {
    const ofRow = row ? lower : weight - lower;
    const right = ofRow * (cellX - x);
    for (let column = 0; column < 2; column++) {
      const ofCell = column ? right : ofRow - right;
      const at = ((y + row) * (CELLS + 2) + x + column) * DIRECTIONS;
      histogram[at + here] += ofCell * (1 - last);
      histogram[at + next] += ofCell * last;
    }
  }
}

/** Bytes as Lowe has them, no number far above the others; then the roots of their shares, of unit length. */
function rooted(descriptor) {
  const most = LARGEST_SHARE * lengthOf(descriptor);
  for (let i = 0; i < descriptor.length; i++) descriptor[i] = Math.min(descriptor[i], most);
  const scale = 512 / Math.max(lengthOf(descriptor), Number.EPSILON);
  let sum = 0;
  for (let i = 0; i < descriptor.length; i++) {
    descriptor[i] = Math.min(Math.round(descriptor[i] * scale), 255);
    sum += descriptor[i];
  }
  for (let i = 0; i < descriptor.length; i++) descriptor[i] = Math.sqrt(descriptor[i] / Math.max(sum, 1));
}

function lengthOf(vector) {
  let square = 0;
  for (let i = 0; i < vector.length; i++) square += vector[i] * vector[i];
  return Math.sqrt(square);
}
