/** Where an image was taken, from a sparse map, as `mambaloc/runtime/maps/localizer.py` finds it. No DOM. */

import { focalScale, project, ransacPose, refinePose, residuals, selected } from "./absolute_pose.js";
import { LEAST_PROBABILITY, MOST_DEVIATION, isAnotherFocalLength, occupiedCells, probabilityOf } from "./acceptance.js";
import { Drift } from "./drift.js";
import { matrixOf, median, quaternionOf } from "./geometry.js";
import { Matcher, matchNearby } from "./matching.js";
import { greyPicture } from "./pictures.js";
import { detectFeatures } from "./sift.js";
import { cameraOf } from "./sparse_map.js";
import { largestEigenvalue } from "./vectors.js";
import { spreadOf, squareBetween, viewpoint } from "./viewpoints.js";

const AT_ONCE = 2500; // points, of those that most frames see, which are matched without a pose
const RATIO = 0.85;
const GUIDED = { ratio: 0.95, farthest: 0.9 };
const NEAREST = 8; // key frames whose points are searched again
const WINDOWS = [6, 2]; // radii of the guided rounds, in times of what is near
const PRIOR_WINDOW = 12; // the same around a prior
const LEAST_SHARE = 0.1;
const SHARED = 1.25; // of variances: neighbouring matches share errors
const LENS_STEPS = 10;
const SAME = 0.01; // of the width, by which a camera may differ from the map's and still be its own

/** Localizes images in a map. */
export class MapLocalizer {
  #map;
  #seed;
  #near; // in the plane at depth 1
  #unit_m;
  #viewpoints;
  #drift;
  #matcher;

  /**
   * @param map of `readMap`.
   * @param {number} seed of RANSAC.
   */
  constructor(map, seed = 0) {
    this.#map = map;
    this.#seed = seed;
    this.#near = (4.5 * map.width) / 160 / map.intrinsics.fx;
    this.#unit_m = spreadOf(map.keyPoses);
    this.#viewpoints = map.keyPoses.map((pose) => viewpoint(pose, this.#unit_m));
    this.#matcher = new Matcher(map.descriptors, AT_ONCE);
    this.#drift = map.drift.length ? new Drift(map.keyPoses, map.drift, map.about.nugget) : null;
  }

  /**
   * Localize one image.
   * @param {{data: Uint8Array|Uint8ClampedArray, width: number, height: number}} image RGB or RGBA.
   * @param {number[][]|null} intrinsics pinhole matrix in its pixels; the map's camera unless given.
   * @param prior a pose to search around where all points at once find none to accept.
   * @returns {object|null} `position_m`, `quaternion_wxyz`, `inliers`, `isAccepted`, `covariance`, `probability` and
   *   `focalScale` as in Python, and `matches`: the point of each, x and y in shares of the image, and how far it is off, 1 at most for inliers.
   *   Null where there is no pose, or the image has another shape than the map's, so that its camera is unknown.
   */
  localize(image, intrinsics = null, prior = null) {
    const camera = intrinsics ? cameraOf(intrinsics.flat()) : this.#cameraFor(image);
    if (!camera) return null;
    const grey = greyPicture(image, this.#map.intrinsics.fx / camera.fx);
    const features = this.#withRays(detectFeatures(grey), grey, rescaled(camera, image, grey));
    const near = this.#near;
    const [seen_m, rays] = this.#matched(features, this.#matcher.match(features, RATIO));
    const found = this.#settled(features, grey, ransacPose(seen_m, rays, near, this.#seed));
    if (!prior || found?.isAccepted) return found;
    const around = { ...prior, rotation: matrixOf(prior.quaternion_wxyz) };
    const matches = this.#search(features, this.#drift?.toAdjusted(around) ?? around, PRIOR_WINDOW * near);
    const guided = ransacPose(...this.#matched(features, matches), near, this.#seed);
    const both = [found, this.#settled(features, grey, guided)].filter(Boolean);
    const rank = (each) => 1e6 * each.isAccepted + 1e5 * each.probability + 1e-6 * each.inliers;
    return both.reduce((best, each) => (best && rank(best) >= rank(each) ? best : each), null);
  }

  /** Search around a pose and refine it, twice; null where that is lost. */
  #settled(features, grey, start) {
    if (!start) return null;
    const near = this.#near;
    let [pose, scale] = [start, near / 2]; // of the refinement; finer where the matches are
    let matches, covariance, off, seen_m, rays, finest;
    for (const window of WINDOWS) {
      matches = this.#search(features, pose, window * near);
      if (matches.points.length < 4) return null;
      [seen_m, rays] = this.#matched(features, matches);
      finest = scale;
      ({ pose, covariance } = refinePose(pose, seen_m, rays, finest));
      off = residuals(pose, seen_m, rays);
      scale = Math.min(near / 2, Math.max(2.5 * median(off.filter(Number.isFinite)), LEAST_SHARE * near));
    }
    const shown = matches.keypoints.map((row, i) => ({
      point: matches.points[i],
      x: (features.pixels[2 * row] + 0.5) / grey.width,
      y: (features.pixels[2 * row + 1] + 0.5) / grey.height,
      off: off[i] / near,
    }));
    const inliers = off.filter((each) => each <= near).length;
    const focal = focalScale(pose, seen_m, rays, finest);
    const focalOff = isAnotherFocalLength(focal) ? focal.scale : null;
    const evidence = this.#evidence(features, start, pose, matches, shown, finest);
    const deviation = Math.max(evidence.deviation, this.#deviation(covariance));
    const probability = focalOff === null ? probabilityOf(evidence.cells, deviation, evidence.turn_deg) : 0;
    const isEnough = probability >= LEAST_PROBABILITY && deviation <= MOST_DEVIATION;
    const carried = this.#drift?.toGiven(pose);
    const { position_m, rotation } = carried?.pose ?? pose;
    return {
      position_m,
      quaternion_wxyz: quaternionOf(rotation),
      inliers,
      isAccepted: isEnough && inliers >= this.#map.about.least_inliers,
      covariance: covariance?.map((row, i) => row.map((value, j) => SHARED * value + (carried?.unsure[i][j] ?? 0))),
      probability,
      focalScale: focalOff,
      matches: shown,
    };
  }

  /** What distinctive matches say of a pose. */
  #evidence(features, start, pose, matches, shown, scale) {
    const rows = this.#matcher.distinctive(features, matches);
    let deviation = Infinity;
    if (rows.length >= 4) {
      const [keypoints, points] = [matches.keypoints, matches.points].map((all) => rows.map((i) => all[i]));
      const { covariance } = refinePose(pose, ...this.#matched(features, { keypoints, points }), scale);
      deviation = this.#deviation(covariance);
    }
    const cells = occupiedCells(rows.map((i) => shown[i]).filter(({ off }) => off <= 1));
    return { cells, deviation, turn_deg: turnBetween(start.rotation, pose.rotation) };
  }

  /** Of the position in the worst direction, over the spread of the key frames. */
  #deviation(covariance) {
    return covariance ? Math.sqrt(largestEigenvalue(covariance)) / this.#unit_m : Infinity;
  }

  /** Match again what a pose projects within a radius of a keypoint. */
  #search(features, pose, radius) {
    const projected = project(pose, this.#map.points_m);
    const visible = this.#visible(features, pose, projected);
    return matchNearby(features, visible, projected, this.#map.descriptors, { radius, ...GUIDED });
  }

  #matched({ rays }, { keypoints, points }) {
    return [selected(this.#map.points_m, points, 3), selected(rays, keypoints, 2)];
  }

  /** Points in the image that one of the nearest key frames sees: what is hidden from there is not searched. */
  #visible({ corners: [left, top, right, bottom] }, pose, projected) {
    const here = viewpoint(pose, this.#unit_m);
    const apart = this.#viewpoints.map((there) => squareBetween(there, here));
    const nearest = [...apart.keys()].sort((a, b) => apart[a] - apart[b]).slice(0, NEAREST);
    const bytes = Math.ceil(this.#viewpoints.length / 8);
    const visible = [];
    for (let point = 0; 2 * point < projected.length; point++) {
      const [x, y] = [projected[2 * point], projected[2 * point + 1]];
      if (!(x >= left && x <= right && y >= top && y <= bottom)) continue;
      const sees = (frame) => this.#map.views[point * bytes + (frame >> 3)] & (128 >> (frame & 7));
      if (nearest.some(sees)) visible.push(point);
    }
    return visible;
  }

  /** Add where keypoints, and the image's upper left and lower right corner, lie in the plane at depth 1. */
  #withRays(features, grey, camera) {
    const { fx, fy, cx, cy } = camera;
    const { lens, intrinsics, width, height } = this.#map;
    const rays = features.pixels.map((value, i) => (i % 2 ? (value - cy) / fy : (value - cx) / fx));
    const isSame = (a, b) => Math.abs(a - b) <= SAME * width;
    const asLarge = rescaled(camera, grey, { width, height });
    const isOwn = Object.keys(camera).every((name) => isSame(asLarge[name], intrinsics[name]));
    if (isOwn && isSame((grey.height * width) / grey.width, height)) straighten(rays, lens);
    const end = { x: grey.width - 0.5, y: grey.height - 0.5 };
    const corners = [(-0.5 - cx) / fx, (-0.5 - cy) / fy, (end.x - cx) / fx, (end.y - cy) / fy];
    return this.#matcher.turned({ ...features, rays, corners });
  }

  /** The map's camera for an image of its shape; null for another. */
  #cameraFor(image) {
    const { width, height, intrinsics } = this.#map;
    if (Math.abs(image.width * height - image.height * width) > Math.max(width, height)) return null;
    return rescaled(intrinsics, this.#map, image);
  }
}

/** Degrees from one rotation, nine numbers row by row, to another. */
function turnBetween(a, b) {
  const square = a.reduce((sum, value, i) => sum + (value - b[i]) ** 2, 0); // 8 sin^2 of half the angle
  return (2 * Math.asin(Math.min(1, Math.sqrt(square / 8))) * 180) / Math.PI;
}

/** A camera's intrinsics once an image is resized; corners stay corners. */
function rescaled({ fx, fy, cx, cy }, from, to) {
  const [x, y] = [to.width / from.width, to.height / from.height];
  return { fx: x * fx, fy: y * fy, cx: x * cx + (x - 1) / 2, cy: y * cy + (y - 1) / 2 };
}

/** Move rays to where a pinhole would see them, by fixed-point steps. */
function straighten(rays, { focal, radial }) {
  for (let i = 0; i < rays.length; i += 2) {
    const [x, y] = [rays[i] / focal, rays[i + 1] / focal];
    [rays[i], rays[i + 1]] = [x, y];
    for (let step = 0; step < LENS_STEPS; step++) {
      const stretch = 1 + radial * (rays[i] ** 2 + rays[i + 1] ** 2);
      [rays[i], rays[i + 1]] = [x / stretch, y / stretch];
    }
  }
}
