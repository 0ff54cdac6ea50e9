/** Poses from images with an exported network. No DOM. */

import { framing } from "./framing.js";
import { Preprocessor } from "./pictures.js";

const UNCERTAINTY = ["position_radius_m", "rotation_radius_deg", "unfamiliarity"];

/** A network on ONNX Runtime. */
export class Network {
  #ort;
  #session;
  #contract;
  #preprocessor = new Preprocessor();

  constructor(ort, session, contract) {
    this.#ort = ort;
    this.#session = session;
    this.#contract = contract;
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
   * Localize one image.
   * @param {{data: Uint8Array|Uint8ClampedArray, width: number, height: number, channels: 3|4}} image RGB or RGBA.
   * @param {number[][]|null} intrinsics pinhole matrix in its pixels, which a model that takes none leaves unread; the
   *   training camera's unless given.
   * @returns `world_from_cam`: the camera centre in metres, a unit quaternion wxyz, and what it took; where the model
   *   estimates them, the radii that most poses are within, and the unfamiliarity, over 1 for an image of elsewhere; where
   *   it knows several scenes, the likeliest one's name, probability, and offset in its world, in whose frame the pose is.
   */
  async localize(image, intrinsics = null) {
    const start = performance.now();
    const feeds = this.#feeds(image, framing(image, this.#contract, intrinsics));
    const fed = performance.now();
    const found = await this.#session.run(feeds);
    const position_m = Array.from(found.position_m.data.slice(0, 3), Number);
    const quaternion_wxyz = Array.from(found.quaternion_wxyz.data.slice(0, 4), Number);
    if (![...position_m, ...quaternion_wxyz].every(Number.isFinite)) {
      throw new Error("The network answered with numbers that are not finite; choose the other backend.");
    }
    const told = UNCERTAINTY.filter((name) => name in found).map((name) => [name, Number(found[name].data[0])]);
    const took = { preprocess_ms: fed - start, network_ms: performance.now() - fed };
    return { position_m, quaternion_wxyz, ...Object.fromEntries(told), ...this.#scene(found), ...took };
  }

  #scene({ scene_probability }) {
    if (!scene_probability) return {};
    const probabilities = Array.from(scene_probability.data.slice(0, this.#contract.scenes.length), Number);
    const likeliest = probabilities.indexOf(Math.max(...probabilities));
    const { name, world } = this.#contract.scenes[likeliest];
    return { scene: name, scene_probability: probabilities[likeliest], offset_m: world.offset_m };
  }

  #feeds(image, { preprocessing, camera }) {
    const { Tensor } = this.#ort;
    const { input, intrinsics_input } = this.#contract;
    const feeds = {};
    if (camera) feeds[intrinsics_input.name] = new Tensor("float32", Float32Array.from(camera.flat()), [1, 3, 3]);
    if (preprocessing.in_model) {
      feeds[input.name] = new Tensor("uint8", asRgb(image), [image.height, image.width, 3]);
    } else {
      const planes = this.#preprocessor.apply(image, preprocessing);
      feeds[input.name] = new Tensor("float32", planes, [1, 3, ...preprocessing.crop]);
    }
    return feeds;
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
