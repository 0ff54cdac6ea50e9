/** Poses from pictures with an exported network. No DOM. */

import { Preprocessor, resizedSize } from "./pictures.js";

const UNCERTAINTY = ["position_radius_m", "rotation_radius_deg", "unfamiliarity"];

/** A network on ONNX Runtime. */
export class Network {
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
    return new Network(ort, await ort.InferenceSession.create(modelBytes, options), contract);
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
