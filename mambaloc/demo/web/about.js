/** What the contract says of the model, for people. */

import { modelOf } from "./localizer.js";

/**
 * Fill the list under "About this model".
 * @param {boolean} verified whether the model's digest was checked.
 */
export function describe(list, contract, verified) {
  const { trained, preprocessing } = contract;
  const [height, width] = preprocessing.crop;
  const file = contract.files[modelOf(contract)];
  const checked = verified ? "checked" : "not checked: that needs HTTPS";
  const rows = {
    Model: contract.model,
    Scene: contract.scene,
    Picture: `short side ${preprocessing.short_side}, then the middle ${width}×${height}`,
    Pose: contract.pose,
    Trained: [trained.device, trained.seed === undefined ? "" : `seed ${trained.seed}`].filter(Boolean).join(", "),
    Commit: trained.commit?.slice(0, 12),
    Weights: short(contract.weights_sha256),
    Map: inWords(contract.map, contract.files["map.safetensors"]),
    File: `${(file.bytes / 1e6).toFixed(1)} MB, ${short(file.sha256)}, ${checked}`,
    Attitude: "heading and horizon are from an “up” that is estimated: the mean over the training cameras",
  };
  list.replaceChildren(
    ...Object.entries(rows)
      .filter(([, text]) => text)
      .flatMap(([name, text]) => [element("dt", name), element("dd", text)]),
  );
}

function element(tag, text) {
  return Object.assign(document.createElement(tag), { textContent: text });
}

function inWords(map, file) {
  if (!map) return "";
  const focal = (map.intrinsics[0][0] / map.size[0]).toFixed(2);
  return (
    `${map.points} points of ${map.key_frames} key frames, ${(file.bytes / 1e6).toFixed(1)} MB. Images are taken ` +
    `to be of its camera, without distortion, focal length ${focal} of the width`
  );
}

function short(digest) {
  return `sha256 ${digest.slice(0, 12)}…`;
}
