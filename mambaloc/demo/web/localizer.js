/**
 * Poses from images with an exported network, and a sparse map beside it where the bundle has one. No DOM: the same
 * file runs in a browser's worker and in Node.
 */

import { MapLocalizer } from "./map_localizer.js";
import { Network } from "./network.js";

const CONTRACT_VERSION = 1;
const MODELS = ["model.onnx", "model.fp16.onnx", "model.int8.onnx", "model.ort"];
const UNSTATED = 0.1; // probability that a network's pose is right which says nothing
const RIGHT = { m: 0.2, deg: 5 };
const LEVEL_SIGMAS = 1.2815515655446004; // nine tenths of a normal variable are below

/** A network, and a map. */
export class Localizer {
  #network;
  #map;

  constructor(network, map = null) {
    this.#network = network;
    this.#map = map;
  }

  /**
   * @param ort onnxruntime-web or onnxruntime-node.
   * @param {Uint8Array} modelBytes of a model of the bundle.
   * @param {object} contract the parsed `contract.json` beside it.
   * @param {object|null} map of `readMap`.
   * @param {object} options of the inference session.
   */
  static async create(ort, modelBytes, contract, map = null, options = {}) {
    checkContract(contract);
    const network = await Network.create(ort, modelBytes, contract, options);
    return new Localizer(network, map && new MapLocalizer(map));
  }

  /**
   * Localize one image: the map's pose where it is accepted or likelier to be right than the network's, which is the
   * answer otherwise.
   * @param {{data: Uint8Array|Uint8ClampedArray, width: number, height: number, channels: 3|4}} image RGB or RGBA.
   * @param {number[][]|null} intrinsics pinhole matrix in its pixels; the training camera's unless given.
   * @returns as {@link Network#localize}; and `source`, "map" or "network"; `network`, its own answer; where there is a
   *   map, `map`, its answer or null, and `map_ms`. Where the map's pose is accepted, the radii are from its covariance.
   */
  async localize(image, intrinsics = null) {
    const network = await this.#network.localize(image, intrinsics);
    if (!this.#map) return { ...network, source: "network", network };
    const start = performance.now();
    const map = this.#map.localize(image, intrinsics, network);
    const both = { ...network, source: "network", network, map, map_ms: performance.now() - start };
    if (!map?.isAccepted && !(map?.probability > probabilityOf(network))) return both;
    const { position_m, quaternion_wxyz } = map;
    const answer = { ...both, source: "map", position_m, quaternion_wxyz };
    if (!map.isAccepted) return answer;
    const [position, rotation] = [0, 3].map((from) => covarianceRadius(map.covariance, from));
    return { ...answer, position_radius_m: position, rotation_radius_deg: (rotation * 180) / Math.PI };
  }
}

/** That a network's pose is right, as `mambaloc/runtime/localization.py` has it. */
function probabilityOf({ position_radius_m, rotation_radius_deg, unfamiliarity }) {
  if (unfamiliarity !== undefined && !(unfamiliarity <= 1)) return 0;
  if (position_radius_m === undefined || rotation_radius_deg === undefined) return UNSTATED;
  // Nine tenths of errors are within a radius; within so many radii are these, if errors are Rayleigh's.
  const radii = [RIGHT.m / position_radius_m, RIGHT.deg / rotation_radius_deg];
  return radii.reduce((share, each) => share * (1 - 0.1 ** (each * each)), 1);
}

/**
 * The radius of the ball that nine of ten errors of a covariance stay in, for three of its rows: Satterthwaite's
 * approximation, as `mambaloc/runtime/maps/radii.py` has it.
 */
function covarianceRadius(covariance, from) {
  const part = covariance.slice(from, from + 3).map((row) => row.slice(from, from + 3));
  const mean = part[0][0] + part[1][1] + part[2][2];
  const share = (2 * part.flat().reduce((sum, value) => sum + value * value, 0)) / (9 * mean * mean);
  return Math.sqrt(mean * (1 - share + LEVEL_SIGMAS * Math.sqrt(share)) ** 3);
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
      `The bundle's contract has version ${found}, but version ${CONTRACT_VERSION} is expected. Export it again.`,
    );
  }
}

/** The most exact of a bundle's models. */
export function modelOf(contract) {
  const found = MODELS.find((file) => file in contract.files);
  if (!found) throw new Error(`The bundle contains no ${MODELS.join(" or ")}. Export it again.`);
  return found;
}
