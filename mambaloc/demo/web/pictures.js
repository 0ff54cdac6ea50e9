/**
 * Images as the network and the map are given them. No DOM.
 *
 * Every step does what `mambaloc/images.py` and `mambaloc/runtime` do with OpenCV, so that an image looks as it did in
 * training.
 */

const IN_UNIT = Float32Array.from({ length: 256 }, (_, value) => value / 255);
const GREY = [9798, 19235, 3735]; // shares of red, green and blue in 1/32768

/** What images go through before the network sees them; keeps its tables while size and resizing stay. */
export class Preprocessor {
  #plan = null;
  #key = "";

  /**
   * Resize, crop and scale; (height, width, channels) in 0..255 -> a new float32 (3, *crop) in 0..1, which is 0 where the
   * image does not reach.
   */
  apply(image, preprocessing) {
    const key = [image.width, image.height, preprocessing.short_side].join();
    if (this.#key !== key) {
      this.#plan = plan(image, preprocessing);
      this.#key = key;
    }
    return this.#plan.shrinks ? averagedColours(image, this.#plan) : interpolated(image, this.#plan);
  }
}

/**
 * The grey image, so many times as wide; larger it never gets.
 * @param {{data: Uint8Array|Uint8ClampedArray, width: number, height: number}} image RGB or RGBA.
 * @returns {{values: Uint8ClampedArray, width: number, height: number}}
 */
export function greyPicture({ data, width, height }, scale) {
  const channels = data.length / (width * height);
  const values = new Uint8ClampedArray(width * height);
  for (let from = 0, to = 0; to < values.length; from += channels, to++) {
    values[to] = (GREY[0] * data[from] + GREY[1] * data[from + 1] + GREY[2] * data[from + 2] + 2 ** 14) >> 15;
  }
  const [across, down] = [width, height].map((side) => Math.max(1, roundHalfToEven(side * Math.min(scale, 1))));
  if (across === width && down === height) return { values, width, height };
  const halves = height === 2 * down && width === 2 * across;
  const areas = { rows: areaTaps(height, down, 0, down), columns: areaTaps(width, across, 0, across), halves };
  return { values: averaged(values, 0, 1, width, areas), width: across, height: down };
}

/** [height, width] of an image once its shorter side has `shortSide` pixels. */
export function resizedSize({ width, height }, shortSide) {
  const scale = shortSide / Math.min(width, height);
  return [roundHalfToEven(height * scale), roundHalfToEven(width * scale)];
}

/** Throw where the model's crop does not fit into the resized image; `orElse` is another way out. */
export function checkHoldsCrop({ width, height }, { short_side, crop }, orElse = "") {
  const [newHeight, newWidth] = resizedSize({ width, height }, short_side);
  if (newHeight >= crop[0] && newWidth >= crop[1]) return;
  const how = width < height ? "turn the camera sideways" : "give an image shaped as in training";
  throw new Error(
    `An image of ${width}×${height} is too narrow: resized to a short side of ${short_side} it does not hold the ` +
      `model's crop of ${crop[1]}×${crop[0]}; ${how}${orElse}.`,
  );
}

/** Which source pixels make each pixel of the crop, along either axis. */
function plan(image, preprocessing) {
  const [height, width] = resizedSize(image, preprocessing.short_side);
  const [cropHeight, cropWidth] = preprocessing.crop;
  const shrinks = height < image.height;
  const taps = shrinks ? areaTaps : linearTaps;
  return {
    shrinks,
    halves: image.height === 2 * height && image.width === 2 * width,
    rows: taps(image.height, height, (height - cropHeight) >> 1, cropHeight, true),
    columns: taps(image.width, width, (width - cropWidth) >> 1, cropWidth, false),
  };
}

/** Overlaps of the pixels' extents, as OpenCV's INTER_AREA counts them. */
function areaTaps(source, target, first, count) {
  const scale = 1 / (target / source);
  const [from, ends, weights] = [new Int32Array(count), new Int32Array(count + 1), []];
  for (let i = 0; i < count; i++) {
    ends[i + 1] = weights.length;
    if (first + i < 0 || first + i >= target) continue; // beyond the image
    const start = (first + i) * scale;
    const end = start + scale;
    const cell = Math.min(scale, source - start);
    const lastWhole = Math.min(Math.floor(end), source - 1);
    const firstWhole = Math.min(Math.ceil(start), lastWhole);
    from[i] = firstWhole;
    if (firstWhole - start > 1e-3) {
      from[i] -= 1;
      weights.push((firstWhole - start) / cell);
    }
    for (let whole = firstWhole; whole < lastWhole; whole++) weights.push(1 / cell);
    if (end - lastWhole > 1e-3) weights.push(Math.min(end - lastWhole, 1, cell) / cell);
    ends[i + 1] = weights.length;
  }
  return { from, ends, weights: Float32Array.from(weights) };
}

/** Averages of an image's red, green and blue. */
function averagedColours({ data, width, channels }, areas) {
  const size = areas.rows.from.length * areas.columns.from.length;
  const planes = new Float32Array(3 * size);
  for (let colour = 0; colour < 3; colour++) {
    const bytes = averaged(data, colour, channels, width, areas);
    for (let i = 0; i < size; i++) planes[colour * size + i] = IN_UNIT[bytes[i]];
  }
  return planes;
}

/** Weighted sums of areas of one channel. Every operation is rounded to float32, as in OpenCV: ties fall as there. */
function averaged(data, channel, channels, width, { rows, columns, halves }) {
  const [height, across] = [rows.from.length, columns.from.length];
  const { fround } = Math;
  const sums = new Float32Array(across);
  const bytes = new Uint8ClampedArray(height * across); // rounds what is stored, halves to even, as OpenCV does
  for (let y = 0; y < height; y++) {
    sums.fill(0);
    for (let j = rows.ends[y]; j < rows.ends[y + 1]; j++) {
      const line = (rows.from[y] + j - rows.ends[y]) * width;
      const share = rows.weights[j];
      for (let x = 0; x < across; x++) {
        let sum = fround(0);
        let at = (line + columns.from[x]) * channels + channel;
        for (let i = columns.ends[x]; i < columns.ends[x + 1]; i++, at += channels) {
          sum = fround(sum + fround(data[at] * columns.weights[i]));
        }
        sums[x] = fround(sums[x] + fround(share * sum));
      }
    }
    // Where both sides are exactly halved, OpenCV adds four pixels as integers and rounds halves up.
    for (let x = 0; x < across; x++) bytes[y * across + x] = halves ? Math.floor(sums[x] + 0.5) : sums[x];
  }
  return bytes;
}

/**
 * Neighbours and their weights in 1/2048, as OpenCV's INTER_LINEAR has them for bytes. At a border it weighs one column
 * fully, but adds up both shares of one row, each rounded down.
 */
function linearTaps(source, target, first, count, isRow) {
  const scale = 1 / (target / source);
  const [from, weights] = [new Int32Array(count), new Int32Array(2 * count)];
  for (let i = 0; i < count; i++) {
    if (first + i < 0 || first + i >= target) continue; // beyond the image
    const centre = Math.fround((first + i + 0.5) * scale - 0.5);
    const floor = Math.floor(centre);
    const inside = floor >= 0 && floor < source - 1;
    const share = inside || isRow ? Math.fround(centre - floor) : 0;
    from[i] = isRow ? floor : Math.min(Math.max(floor, 0), source - 1);
    weights[2 * i] = roundHalfToEven(2048 * Math.fround(1 - share));
    weights[2 * i + 1] = roundHalfToEven(2048 * share);
  }
  return { from, weights, last: source - 1 };
}

/** Between four neighbours, in OpenCV's fixed point. */
function interpolated({ data, width, channels }, { rows, columns }) {
  const [height, across] = [rows.from.length, columns.from.length];
  const planes = new Float32Array(3 * height * across);
  for (let y = 0; y < height; y++) {
    const [upper, lower] = [0, 1].map((i) => width * Math.min(Math.max(rows.from[y] + i, 0), rows.last));
    for (let x = 0; x < across; x++) {
      const left = columns.from[x];
      const right = Math.min(left + 1, columns.last);
      for (let c = 0; c < 3; c++) {
        const between = (line) =>
          data[(line + left) * channels + c] * columns.weights[2 * x] +
          data[(line + right) * channels + c] * columns.weights[2 * x + 1];
        const top = (rows.weights[2 * y] * (between(upper) >> 4)) >> 16;
        const bottom = (rows.weights[2 * y + 1] * (between(lower) >> 4)) >> 16;
        planes[(c * height + y) * across + x] = IN_UNIT[(top + bottom + 2) >> 2];
      }
    }
  }
  return planes;
}

/** Python's `round`. */
export function roundHalfToEven(value) {
  const floor = Math.floor(value);
  if (value - floor !== 0.5) return Math.round(value);
  return floor % 2 === 0 ? floor : floor + 1;
}
