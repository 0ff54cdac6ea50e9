/** What lens took an image, if it is stated, and what part of the image the model sees. */

import { cameraOfLens, framing } from "./framing.js";

const $ = (id) => document.getElementById(id);

/** Ask for the lens of images that any camera may have taken, where the answer depends on it. */
export function askForLens(source, dependsOnIt) {
  $("lens").hidden = !dependsOnIt || !isOfAnyCamera(source);
}

/** The camera of an image by the lens that was stated; null: take it for the training camera's. */
export function statedCamera(source, image) {
  const { valueAsNumber: focalMm, validity } = $("focal");
  return isOfAnyCamera(source) && validity.valid && focalMm ? cameraOfLens(image, focalMm) : null;
}

/**
 * Outline the part of the image that the model sees.
 *
 * Throws as {@link framing}.
 */
export function outlineCrop({ width, height }, contract, intrinsics) {
  const outline = $("crop");
  outline.hidden = true;
  outline.parentElement.style.setProperty("--aspect", width / height);
  const { short_side, crop } = framing({ width, height }, contract, intrinsics).preprocessing;
  const scale = short_side / Math.min(width, height);
  const [share, across] = [height, width].map((side, i) => Math.min(1, crop[i] / (side * scale)));
  outline.style.setProperty("--height", `${100 * share}%`);
  outline.style.setProperty("--width", `${100 * across}%`);
  outline.hidden = false;
}

function isOfAnyCamera(source) {
  return source === "camera" || source === "photo";
}
