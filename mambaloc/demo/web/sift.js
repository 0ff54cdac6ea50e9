/**
 * SIFT (Lowe 2004) with RootSIFT descriptors (Arandjelović and Zisserman 2012). No DOM.
 *
 * Its keypoints are those of OpenCV's `SIFT_create(1000, contrastThreshold=0.02, enable_precise_upscale=True)`, by which
 * maps are built, so that one map serves Python and the page; tests/demo/test_map.py compares them.
 */

const MOST_KEYPOINTS = 1000;
const CONTRAST = 0.02;
const EDGE = 10; // largest ratio of the principal curvatures
const LAYERS = 3; // of an octave, in which extrema are searched
const SIGMA = 1.6; // of an octave's first layer, in its pixels
const CAMERA_SIGMA = 0.5; // that pictures come with
const BORDER = 5; // pixels of an octave without keypoints
const FIT_STEPS = 5;
const BINS = 36; // of the histogram of orientations
const PEAK = 0.8; // of its highest bin, from which another one is an orientation too
const CELLS = 4; // a side of the descriptor
const DIRECTIONS = 8; // a cell
const CELL_SIGMAS = 3; // side of a cell in the keypoint's scale
const TURN = 2 * Math.PI;
const ARC = [0.99986633, -0.33030475, 0.18015914, -0.08515611, 0.02084499]; // of the best odd polynomial for the arctangent
const LARGEST_SHARE = 0.2; // of a descriptor's length, that one number may have

/**
 * Find the keypoints of a grey picture.
 * @param {{values: Uint8Array|Float32Array, width: number, height: number}} grey in 0..255.
 * @returns {{count: number, pixels: Float64Array, descriptors: Float32Array}} x, y of each keypoint, where the centre of
 *   the top left pixel is (0, 0), and 128 numbers of unit length.
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
  const descriptors = new Float32Array(CELLS * CELLS * DIRECTIONS * kept.length);
  kept.forEach((keypoint, i) => {
    pixels[2 * i] = keypoint.x;
    pixels[2 * i + 1] = keypoint.y;
    describe(keypoint, descriptors.subarray(128 * i, 128 * (i + 1)));
  });
  return { count: kept.length, pixels, descriptors };
}

/** The strongest keypoints; what is as strong as the last one stays, too. */
function strongest(keypoints) {
  const sorted = keypoints.sort((a, b) => b.strength - a.strength);
  const least = sorted[MOST_KEYPOINTS - 1]?.strength ?? 0;
  return sorted.filter(({ strength }) => strength >= least);
}

// Scale space

/** Octaves from twice the picture's size down: blurred layers and their differences. `pixel` is a pixel's size. */
function octavesOf(grey) {
  const sigmas = Array.from({ length: LAYERS + 3 }, (_, i) => SIGMA * 2 ** (i / LAYERS));
  const kernels = sigmas.map((sigma, i) => gaussian(Math.sqrt(sigma ** 2 - (i ? sigmas[i - 1] : 2 * CAMERA_SIGMA) ** 2)));
  let base = blurred(doubled(grey), kernels[0]);
  const octaves = [];
  for (let pixel = 0.5; Math.min(base.width, base.height) > 2 * BORDER; pixel *= 2) {
    const layers = [base];
    for (const kernel of kernels.slice(1)) layers.push(blurred(layers.at(-1), kernel));
    octaves.push({ pixel, layers, differences: layers.slice(1).map((layer, i) => difference(layer, layers[i])) });
    base = halved(layers[LAYERS]);
  }
  return octaves;
}

/** Twice as large: every other pixel is one of the picture, those between are means. */
function doubled({ values, width, height }) {
  const [across, down] = [2 * width, 2 * height];
  const to = new Float32Array(across * down);
  for (let y = 0; y < down; y++) {
    const [upper, lower] = [y >> 1, Math.min((y + 1) >> 1, height - 1)].map((row) => row * width);
    for (let x = 0; x < across; x++) {
      const [left, right] = [x >> 1, Math.min((x + 1) >> 1, width - 1)];
      to[y * across + x] =
        (values[upper + left] + values[upper + right] + values[lower + left] + values[lower + right]) / 4;
    }
  }
  return { values: to, width: across, height: down };
}

function halved({ values, width, height }) {
  const [across, down] = [width >> 1, height >> 1];
  const to = new Float32Array(across * down);
  for (let y = 0; y < down; y++) {
    const row = Math.floor((y * height) / down) * width;
    for (let x = 0; x < across; x++) to[y * across + x] = values[row + Math.floor((x * width) / across)];
  }
  return { values: to, width: across, height: down };
}

function difference(a, b) {
  const values = new Float32Array(a.values.length);
  for (let i = 0; i < values.length; i++) values[i] = a.values[i] - b.values[i];
  return { ...a, values };
}

/** The middle and one side of a Gaussian's weights, out to four standard deviations. */
function gaussian(sigma) {
  const reach = Math.round(8 * sigma + 1) >> 1;
  const half = Array.from({ length: reach + 1 }, (_, i) => Math.exp((-i * i) / (2 * sigma * sigma)));
  const sum = 2 * half.reduce((a, b) => a + b) - half[0];
  return Float32Array.from(half, (weight) => weight / sum);
}

function blurred(plane, kernel) {
  return blurredAlongRows(blurredAlongRows(plane, kernel), kernel);
}

/** Blur along rows, and swap rows for columns: twice that is a blur both ways. Borders mirror what is inside. */
function blurredAlongRows({ values, width, height }, kernel) {
  const reach = kernel.length - 1;
  const line = new Float64Array(width + 2 * reach + 3);
  const sources = Int32Array.from({ length: width + 2 * reach }, (_, i) => mirrored(i - reach, width));
  const to = new Float32Array(values.length + 3 * height); // four at once may be too many
  for (let y = 0; y < height; y++) {
    for (let i = 0; i < sources.length; i++) line[i] = values[y * width + sources[i]];
    for (let x = 0; x < width; x += 4) {
      const middle = x + reach;
      let a = kernel[0] * line[middle];
      let b = kernel[0] * line[middle + 1];
      let c = kernel[0] * line[middle + 2];
      let d = kernel[0] * line[middle + 3];
      for (let i = 1, left = middle - 1, right = middle + 1; i <= reach; i++, left--, right++) {
        const weight = kernel[i];
        a += weight * (line[left] + line[right]);
        b += weight * (line[left + 1] + line[right + 1]);
        c += weight * (line[left + 2] + line[right + 2]);
        d += weight * (line[left + 3] + line[right + 3]);
      }
      const at = x * height + y;
      to[at] = a;
      to[at + height] = b;
      to[at + 2 * height] = c;
      to[at + 3 * height] = d;
    }
  }
  return { values: to.subarray(0, values.length), width: height, height: width };
}

function mirrored(x, length) {
  let inside = x;
  while (inside < 0 || inside >= length) inside = inside < 0 ? -inside : 2 * (length - 1) - inside;
  return inside;
}

// Keypoints

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
    if (offset.every((each) => Math.abs(each) < 0.5)) return judged(octave, layer, x, y, offset, gradient, hessian, value);
    [x, y, layer] = [x, y, layer].map((each, i) => each + Math.round(offset[i]));
    const inside = x >= BORDER && x < width - BORDER && y >= BORDER && y < height - BORDER;
    if (!inside || !(layer >= 1 && layer <= LAYERS)) return null;
  }
  return null;
}

function judged({ pixel, layers }, layer, column, row, [dx, dy, dLayer], gradient, hessian, value) {
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

/** Central differences along x, y and the layers of pictures in 0..1. */
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
  const cross = (p, q) => [p[1] * q[2] - p[2] * q[1], p[2] * q[0] - p[0] * q[2], p[0] * q[1] - p[1] * q[0]];
  const dot = (p, q) => p[0] * q[0] + p[1] * q[1] + p[2] * q[2];
  const determinant = dot(a, cross(b, c)); // symmetric: rows are columns
  if (!determinant) return null;
  return [dot(right, cross(b, c)), dot(a, cross(right, c)), dot(a, cross(b, right))].map((each) => each / determinant);
}

// Orientation and descriptor

/** The directions, from x towards y in radians, of most gradients about an extremum. */
function orientationsOf({ image, column, row, scale }) {
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
    if (value > left && value > right && value >= least) peaks.push(i + (0.5 * (left - right)) / (left - 2 * value + right));
  });
  return peaks;
}

/**
 * Write the RootSIFT descriptor of a keypoint: histograms of directions in 4x4 cells turned to its own, each gradient
 * shared among the nearest cells and directions.
 */
function describe({ image, column, row, scale, angle }, to) {
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
