/**
 * Carries poses between a map's frame, which was adjusted to the images, and that of the poses it was given, as
 * `mambaloc/runtime/maps/drift.py` does. No DOM.
 */

import { moved } from "./absolute_pose.js";
import { inverse, product, transposed } from "./vectors.js";
import { spreadOf, squareBetween, viewpoint } from "./viewpoints.js";

const LENGTH = 8; // of the kernel, in units of viewpoints
const NUGGET = 1e-3; // variance of a single key frame's move, over that of the drift, of maps that do not say it

/** The drift of key frames: a Gaussian process over viewpoints. */
export class Drift {
  #unit_m;
  #places;
  #weights;
  #inverse;
  #amplitude;
  #nugget;

  /**
   * @param {object[]} keyPoses adjusted to the images.
   * @param {number[][]} weights six of each: of the shift in metres and the turn in radians along the camera's axes.
   * @param {number} nugget with which they were fitted.
   */
  constructor(keyPoses, weights, nugget = NUGGET) {
    this.#unit_m = spreadOf(keyPoses);
    this.#places = keyPoses.map((pose) => viewpoint(pose, this.#unit_m));
    this.#weights = weights;
    this.#nugget = nugget;
    const covariance = this.#places.map((place) => this.#near(place));
    covariance.forEach((row, i) => (row[i] += nugget));
    this.#inverse = inverse(covariance);
    const squares = product(transposed(weights), product(covariance, weights));
    this.#amplitude = squares.map((row) => row.map((value) => value / weights.length)); // most likely
  }

  /**
   * Carry a pose from the adjusted frame to that of the given poses.
   * @returns {{pose: object, unsure: number[][]}} and the covariance of what was added.
   */
  toGiven(pose) {
    const near = [this.#near(viewpoint(pose, this.#unit_m))];
    const [[known]] = product(product(near, this.#inverse), transposed(near));
    const axes = axesOf(pose);
    const share = Math.max(1 + this.#nugget - known, 0);
    const unsure = product(product(axes, this.#amplitude), transposed(axes));
    return {
      pose: moved(pose, product(axes, transposed(product(near, this.#weights))).flat()),
      unsure: unsure.map((row) => row.map((value) => share * value)),
    };
  }

  /** Carry a pose back, to first order: drift hardly differs between the two. */
  toAdjusted(pose) {
    const drift = transposed(product([this.#near(viewpoint(pose, this.#unit_m))], this.#weights));
    const back = (from) => product(axesOf(from), drift).map(([value]) => -value);
    const unturned = moved(pose, [0, 0, 0, ...back(pose).slice(3)]);
    return moved(unturned, [...back(unturned).slice(0, 3), 0, 0, 0]);
  }

  /** Matérn's covariance of smoothness 3/2 with every key frame. */
  #near(place) {
    return this.#places.map((other) => {
      const apart = Math.sqrt(3 * squareBetween(place, other)) / LENGTH;
      return (1 + apart) * Math.exp(-apart);
    });
  }
}

/** The rotation twice, from shift and turn along the camera's axes to those along the world's. */
function axesOf({ rotation }) {
  return [0, 1, 2, 3, 4, 5].map((i) =>
    [0, 1, 2, 3, 4, 5].map((j) => (i < 3 === j < 3 ? rotation[3 * (i % 3) + (j % 3)] : 0)),
  );
}
