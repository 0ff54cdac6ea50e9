/**
 * Poses from pictures with an exported model. No DOM: the same file runs in a browser's worker and in Node.
 *
 * Every step does what `mambaloc/images.py` and `mambaloc/runtime` do with OpenCV, so that a picture looks to the
 * network as it did in training.
 */

const CONTRACT_VERSION = 1;
const MODELS = ["model.onnx", "model.fp16.onnx", "model.int8.onnx", "model.ort"];
const UNCERTAINTY = ["position_radius_m", "rotation_radius_deg", "unfamiliarity"];
const IN_UNIT = Float32Array.from({ length: 256 }, (_, value) => value / 255);

/** A model on ONNX Runtime. */
export class Localiser {
  #ort;
  #session;
  #contract;
  #preprocessor;

  constructor(ort, session, contract) {
    this.#ort = ort;
    this.#session = session;
    this.#contract = contract;
    this.#preprocessor = new Preprocessor(contract.preprocessing);
  }

  /**
   * @param ort onnxruntime-web or onnxruntime-node.
   * @param {Uint8Array} modelBytes of a model of the bundle.
   * @param {object} contract the parsed `contract.json` beside it.
   * @param {object} options of the inference session.
   */
  static async create(ort, modelBytes, contract, options = {}) {
    checkContract(contract);
    return new Localiser(ort, await ort.InferenceSession.create(modelBytes, options), contract);
  }

  /**
   * Localise one picture.
   * @param {{data: Uint8Array|Uint8ClampedArray, width: number, height: number, channels: 3|4}} image RGB or RGBA.
   * @returns `world_from_cam`: the camera centre in metres, a unit quaternion wxyz, and what it took; where the model
   *   tells them, the radii that most poses are within, and the unfamiliarity, over 1 for a picture of elsewhere.
   */
  async localise(image) {
    const start = performance.now();
    const tensor = this.#tensor(image);
    const fed = performance.now();
    const found = await this.#session.run({ [this.#contract.input.name]: tensor });
    const position_m = Array.from(found.position_m.data.slice(0, 3), Number);
    const quaternion_wxyz = Array.from(found.quaternion_wxyz.data.slice(0, 4), Number);
    if (![...position_m, ...quaternion_wxyz].every(Number.isFinite)) {
      throw new Error("The network answered with numbers that are not finite; choose the other backend.");
    }
    const told = UNCERTAINTY.filter((name) => name in found).map((name) => [name, Number(found[name].data[0])]);
    const took = { preprocess_ms: fed - start, network_ms: performance.now() - fed };
    return { position_m, quaternion_wxyz, ...Object.fromEntries(told), ...took };
  }

  #tensor(image) {
    if (this.#contract.preprocessing.in_model) {
      resizedSize(image, this.#contract.preprocessing);
      return new this.#ort.Tensor("uint8", asRgb(image), [image.height, image.width, 3]);
    }
    const [height, width] = this.#contract.preprocessing.crop;
    return new this.#ort.Tensor("float32", this.#preprocessor.apply(image), [1, 3, height, width]);
  }
}

/** What an image goes through before the network sees it; keeps its tables while the pictures' size stays. */
export class Preprocessor {
  #preprocessing;
  #plan = null;
  #size = "";

  constructor(preprocessing) {
    this.#preprocessing = preprocessing;
  }

  /** Resize, crop and scale; (height, width, channels) in 0..255 -> a new float32 (3, *crop) in 0..1. */
  apply(image) {
    const { width, height } = image;
    if (this.#size !== `${width}x${height}`) {
      this.#plan = plan(image, this.#preprocessing);
      this.#size = `${width}x${height}`;
    }
    return this.#plan.shrinks ? averaged(image, this.#plan) : interpolated(image, this.#plan);
  }
}

/** As {@link Preprocessor#apply}, once. */
export function preprocess(image, preprocessing) {
  return new Preprocessor(preprocessing).apply(image);
}

/** How far pose `a` is from pose `b`: millimetres and degrees. */
export function deviation(a, b) {
  const [p, q] = [a.quaternion_wxyz, b.quaternion_wxyz];
  const apart = [Math.hypot(...p.map((value, i) => value - q[i])), Math.hypot(...p.map((value, i) => value + q[i]))];
  return {
    mm: 1000 * Math.hypot(...a.position_m.map((value, i) => value - b.position_m[i])),
    deg: (4 * Math.atan2(Math.min(...apart), Math.max(...apart)) * 180) / Math.PI,
  };
}

/** Throw unless this page knows how to obey the contract. */
export function checkContract(contract) {
  if (contract?.contract !== CONTRACT_VERSION) {
    const found = JSON.stringify(contract?.contract) ?? "none";
    throw new Error(
      `The bundle's contract is of version ${found}, this reads ${CONTRACT_VERSION}; export it anew.`,
    );
  }
}

/** The most exact of a bundle's models. */
export function modelOf(contract) {
  const found = MODELS.find((file) => file in contract.files);
  if (!found) throw new Error(`The bundle holds none of ${MODELS.join(", ")}; export it anew.`);
  return found;
}

/**
 * [height, width] of an image once its shorter side has `short_side` pixels.
 *
 * Throws where the model's crop does not fit into that.
 */
export function resizedSize({ width, height }, { short_side, crop }) {
  const scale = short_side / Math.min(width, height);
  const size = [roundHalfToEven(height * scale), roundHalfToEven(width * scale)];
  if (size[0] < crop[0] || size[1] < crop[1]) {
    const how = width < height ? "turn the camera sideways" : "give a picture shaped as in training";
    throw new Error(
      `A picture of ${width}×${height} is too narrow: resized to a short side of ${short_side} it does not hold the ` +
        `model's crop of ${crop[1]}×${crop[0]}; ${how}.`,
    );
  }
  return size;
}

function asRgb({ data, width, height, channels }) {
  if (channels === 3) return data instanceof Uint8Array ? data : new Uint8Array(data);
  const rgb = new Uint8Array(width * height * 3);
  for (let from = 0, to = 0; to < rgb.length; from += 4, to += 3) {
    rgb[to] = data[from];
    rgb[to + 1] = data[from + 1];
    rgb[to + 2] = data[from + 2];
  }
  return rgb;
}

/** Which source pixels make each pixel of the crop, along either axis. */
function plan(image, preprocessing) {
  const [height, width] = resizedSize(image, preprocessing);
  const [cropHeight, cropWidth] = preprocessing.crop;
  const shrinks = height < image.height;
  const taps = shrinks ? areaTaps : linearTaps;
  return {
    shrinks,
    halves: image.height === 2 * height && image.width === 2 * width,
    rows: taps(image.height, height, (height - cropHeight) >> 1, cropHeight),
    columns: taps(image.width, width, (width - cropWidth) >> 1, cropWidth),
    sums: new Float32Array(3 * cropWidth),
    bytes: new Uint8ClampedArray(3 * cropWidth), // rounds what is stored, halves to even, as OpenCV does
  };
}

/** Overlaps of the pixels' extents, as OpenCV's INTER_AREA counts them. */
function areaTaps(source, target, first, count) {
  const scale = 1 / (target / source);
  const [from, ends, weights] = [new Int32Array(count), new Int32Array(count + 1), []];
  for (let i = 0; i < count; i++) {
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

/** Weighted sums of areas. Every operation is rounded to float32, as in OpenCV: ties then fall as they do there. */
function averaged({ data, width, channels }, { rows, columns, sums, bytes, halves }) {
  const [height, across] = [rows.from.length, columns.from.length];
  const planes = new Float32Array(3 * height * across);
  const { fround } = Math;
  for (let y = 0; y < height; y++) {
    sums.fill(0);
    for (let j = rows.ends[y]; j < rows.ends[y + 1]; j++) {
      const line = (rows.from[y] + j - rows.ends[y]) * width;
      const share = rows.weights[j];
      for (let x = 0, to = 0; x < across; x++, to += 3) {
        let [red, green, blue] = [fround(0), fround(0), fround(0)];
        let at = (line + columns.from[x]) * channels;
        for (let i = columns.ends[x]; i < columns.ends[x + 1]; i++, at += channels) {
          const weight = columns.weights[i];
          red = fround(red + fround(data[at] * weight));
          green = fround(green + fround(data[at + 1] * weight));
          blue = fround(blue + fround(data[at + 2] * weight));
        }
        sums[to] = fround(sums[to] + fround(share * red));
        sums[to + 1] = fround(sums[to + 1] + fround(share * green));
        sums[to + 2] = fround(sums[to + 2] + fround(share * blue));
      }
    }
    // Where both sides are exactly halved, OpenCV adds four pixels as integers and rounds halves up.
    for (let i = 0; i < sums.length; i++) bytes[i] = halves ? Math.floor(sums[i] + 0.5) : sums[i];
    store(bytes, planes, y, height, across);
  }
  return planes;
}

/** Neighbours and their weights in 1/2048, as OpenCV's INTER_LINEAR has them for bytes. */
function linearTaps(source, target, first, count) {
  const scale = 1 / (target / source);
  const [from, weights] = [new Int32Array(count), new Int32Array(2 * count)];
  for (let i = 0; i < count; i++) {
    const centre = Math.fround((first + i + 0.5) * scale - 0.5);
    const floor = Math.floor(centre);
    const inside = floor >= 0 && floor < source - 1;
    const share = inside ? Math.fround(centre - floor) : 0;
    from[i] = Math.min(Math.max(floor, 0), source - 1);
    weights[2 * i] = roundHalfToEven(2048 * Math.fround(1 - share));
    weights[2 * i + 1] = roundHalfToEven(2048 * share);
  }
  return { from, weights, last: source - 1 };
}

/** Between four neighbours, in OpenCV's fixed point. */
function interpolated({ data, width, channels }, { rows, columns, bytes }) {
  const [height, across] = [rows.from.length, columns.from.length];
  const planes = new Float32Array(3 * height * across);
  for (let y = 0; y < height; y++) {
    const upper = rows.from[y] * width;
    const lower = Math.min(rows.from[y] + 1, rows.last) * width;
    for (let x = 0; x < across; x++) {
      const left = columns.from[x];
      const right = Math.min(left + 1, columns.last);
      for (let c = 0; c < 3; c++) {
        const between = (line) =>
          data[(line + left) * channels + c] * columns.weights[2 * x] +
          data[(line + right) * channels + c] * columns.weights[2 * x + 1];
        const top = (rows.weights[2 * y] * (between(upper) >> 4)) >> 16;
        const bottom = (rows.weights[2 * y + 1] * (between(lower) >> 4)) >> 16;
        bytes[3 * x + c] = (top + bottom + 2) >> 2;
      }
    }
    store(bytes, planes, y, height, across);
  }
  return planes;
}

/** Lay one row of RGB bytes out as three planes' rows in 0..1. */
function store(bytes, planes, y, height, width) {
  for (let c = 0; c < 3; c++) {
    for (let x = 0, to = (c * height + y) * width; x < width; x++) planes[to + x] = IN_UNIT[bytes[3 * x + c]];
  }
}

/** Python's `round`. */
function roundHalfToEven(value) {
  const floor = Math.floor(value);
  if (value - floor !== 0.5) return Math.round(value);
  return floor % 2 === 0 ? floor : floor + 1;
}
