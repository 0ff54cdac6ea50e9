/** A sparse map's file: points of a place and what they look like. No DOM. */

import { LENGTH } from "./descriptors.js";

const VERSION = 1;
const TYPES = { F32: Float32Array, F64: Float64Array, U8: Uint8Array, I64: BigInt64Array };

/**
 * Read what `mambaloc/runtime/maps/sparse_map.py` wrote: safetensors, whose header says where each array lies.
 * @param {Uint8Array} bytes of the whole file.
 * @returns what is there: `points_m` and `views` row by row, `descriptors` as floats of unit length.
 */
export function readMap(bytes) {
  const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
  const start = 8 + Number(view.getBigUint64(0, true));
  const { __metadata__: metadata, ...arrays } = JSON.parse(new TextDecoder().decode(bytes.subarray(8, start)));
  const about = JSON.parse(metadata.about);
  if (about.version > VERSION) {
    throw new Error(`The map is of version ${about.version}, and this page reads up to ${VERSION}. Update the page.`);
  }
  const array = (name) => {
    const { dtype, data_offsets: [from, to] } = arrays[name];
    return new TYPES[dtype](bytes.slice(start + from, start + to).buffer);
  };
  const [width, height] = Array.from(array("size"), Number);
  return {
    about,
    points_m: Float64Array.from(array("points_m")),
    descriptors: ofUnitLength(array("descriptors")),
    views: array("views"),
    keyPoses: rowsOf(array("key_poses"), 16).map(poseOf),
    drift: rowsOf(array("drift"), 6),
    lens: lensOf(array("lens")),
    intrinsics: cameraOf(array("intrinsics")),
    width,
    height,
  };
}

/** Focal lengths and centre of a pinhole matrix of nine numbers. */
export function cameraOf([fx, , cx, , fy, cy]) {
  return { fx, fy, cx, cy };
}

/** `world_from_cam` of a transform of 4x4. */
function poseOf(m) {
  return { rotation: [m[0], m[1], m[2], m[4], m[5], m[6], m[8], m[9], m[10]], position_m: [m[3], m[7], m[11]] };
}

/** The true focal length over the claimed one, and the first coefficient of radial distortion. */
function lensOf([focal, radial]) {
  return { focal, radial };
}

function rowsOf(values, columns) {
  return Array.from({ length: values.length / columns }, (_, i) =>
    Array.from(values.subarray(i * columns, (i + 1) * columns)),
  );
}

function ofUnitLength(bytes) {
  const descriptors = Float32Array.from(bytes);
  for (let from = 0; from < descriptors.length; from += LENGTH) {
    const one = descriptors.subarray(from, from + LENGTH);
    const length = Math.sqrt(one.reduce((sum, value) => sum + value * value, 0));
    for (let i = 0; i < LENGTH; i++) one[i] /= Math.max(length, 1);
  }
  return descriptors;
}
