/** Images blurred more and more, and their differences (Lowe 2004, section 3), as OpenCV computes them. No DOM. */

export const LAYERS = 3; // of an octave, in which extrema are searched
export const SIGMA = 1.6; // of an octave's first layer, in its pixels
export const BORDER = 5; // pixels of an octave without keypoints
const CAMERA_SIGMA = 0.5; // that images come with

/** Octaves from twice the image's size down: blurred layers and their differences. `pixel` is a pixel's size. */
export function octavesOf(grey) {
  const sigmas = Array.from({ length: LAYERS + 3 }, (_, i) => SIGMA * 2 ** (i / LAYERS));
  const before = [2 * CAMERA_SIGMA, ...sigmas]; // the image is doubled first
  const kernels = sigmas.map((sigma, i) => gaussian(Math.sqrt(sigma ** 2 - before[i] ** 2)));
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

/** Twice as large: every other pixel is one of the image, those between are means. */
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
