/**
 * How an image of any camera becomes what the network is fed, as `mambaloc/runtime/contract.py` has it. No DOM.
 */

import { checkHoldsCrop, resizedSize, roundHalfToEven } from "./pictures.js";

const MOST_ENLARGED = 4;
const FULL_FRAME_MM = Math.hypot(36, 24);

/**
 * The image's resizing, and its camera as the model is fed it.
 * @param {{width: number, height: number}} image
 * @param {object} contract of a bundle.
 * @param {number[][]|null} intrinsics pinhole matrix in the image's pixels; the training camera's unless given.
 * @returns {{preprocessing: object, camera: number[][]|null}} `camera` is null for a model that takes none.
 *
 * Throws where the camera is unknown, and the model's crop does not fit into the image.
 */
export function framing(image, contract, intrinsics = null) {
  const { preprocessing: usual, intrinsics: trained = null } = contract;
  if (!trained || !intrinsics) {
    checkHoldsCrop(image, usual, trained ? ", or say what lens took it" : "");
    return { preprocessing: usual, camera: trained && usual.in_model ? imageCamera(image, usual, trained) : trained };
  }
  const preprocessing = { ...usual, short_side: shortSide(image, usual, trained[0][0] / intrinsics[0][0]) };
  return { preprocessing, camera: usual.in_model ? intrinsics : cropCamera(image, preprocessing, intrinsics) };
}

/**
 * The pinhole matrix of a lens whose axis meets the image in its middle.
 * @param {{width: number, height: number}} image
 * @param {number} focalMm focal length of the lens that sees as much across the diagonal of 35 mm film.
 */
export function cameraOfLens({ width, height }, focalMm) {
  const focal = (focalMm * Math.hypot(width, height)) / FULL_FRAME_MM;
  return pinhole(focal, focal, (width - 1) / 2, (height - 1) / 2);
}

/** Things become as large as the training camera shows them; the crop may then be black at its border. */
function shortSide({ width, height }, { short_side }, focalRatio) {
  const asLarge = roundHalfToEven(Math.min(width, height) * focalRatio);
  return Math.min(Math.max(asLarge, 1), MOST_ENLARGED * short_side);
}

/** From an image's camera to its crop's. */
function cropCamera(image, preprocessing, [[fx, , cx], [, fy, cy]]) {
  const [x, y] = cropAxes(image, preprocessing);
  return pinhole(x.scale * fx, y.scale * fy, x.scale * cx + x.shift, y.scale * cy + y.shift);
}

/** From a crop's camera to its image's. */
function imageCamera(image, preprocessing, [[fx, , cx], [, fy, cy]]) {
  const [x, y] = cropAxes(image, preprocessing);
  return pinhole(fx / x.scale, fy / y.scale, (cx - x.shift) / x.scale, (cy - y.shift) / y.scale);
}

/** An image's columns and rows become `scale` times that plus `shift` in the crop. */
function cropAxes({ width, height }, { short_side, crop }) {
  const [newHeight, newWidth] = resizedSize({ width, height }, short_side);
  const axes = [
    [width, newWidth, crop[1]],
    [height, newHeight, crop[0]],
  ];
  return axes.map(([side, resized, cropped]) => {
    const scale = resized / side;
    return { scale, shift: (scale - 1) / 2 - ((resized - cropped) >> 1) };
  });
}

function pinhole(fx, fy, cx, cy) {
  return [
    [fx, 0, cx],
    [0, fy, cy],
    [0, 0, 1],
  ];
}
