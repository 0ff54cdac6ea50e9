/** The numbers on the page. */

import { attitude, median } from "./geometry.js";
import { deviation } from "./localizer.js";

const LATENCIES = 30;
const RATE_WINDOW_MS = 2000;

const shown = (name) => document.querySelector(`[data-show="${name}"]`);
const signed = (value, digits) => value.toFixed(digits).replace("-", "−"); // a minus as wide as a plus

/** A number that is no smaller than it reads: "< 0.001" rather than "0.000". */
export function small(value, digits) {
  return value < 10 ** -digits ? `< ${10 ** -digits}` : value.toFixed(digits);
}

/** Shows poses, their errors, and how fast they come. */
export class Readout {
  #element = document.getElementById("pose");
  #count = 0;
  #latencies = [];
  #times = [];
  #errors = [];
  #last = -1;

  /** Added to the positions of the scene's frame, it gives those of the data that the scene was made of. */
  offset = [0, 0, 0];

  /** @param {number[]|null} up of the scene; without it there is no attitude to show. */
  constructor(up) {
    this.up = up;
    for (const cell of document.querySelectorAll(".attitude")) cell.hidden = !up;
  }

  /** Start over, with another source or a new run of the film. */
  restart() {
    this.#latencies = [];
    this.#times = [];
    this.forgetErrors();
    for (const name of ["fps", "latency"]) shown(name).textContent = "–";
    shown("latency-detail").textContent = "";
  }

  forgetErrors() {
    this.#errors = [];
    this.#last = -1;
    delete this.#element.dataset.filmFrame;
    document.getElementById("errors").hidden = true;
  }

  /**
   * Show one answer.
   * @param pose of the localizer.
   * @param {string} source that the image is from.
   * @param {string} file of a test frame, or "".
   */
  show(pose, source, file = "") {
    const { quaternion_wxyz, offset_m = this.offset } = pose;
    const position_m = pose.position_m.map((value, axis) => value + offset_m[axis]);
    const data = this.#element.dataset;
    data.positionM = JSON.stringify(position_m);
    data.quaternionWxyz = JSON.stringify(quaternion_wxyz);
    data.source = source;
    data.frameFile = file;
    ["x", "y", "z"].forEach((axis, i) => (shown(axis).textContent = signed(position_m[i], 3)));
    shown("quaternion").textContent = quaternion_wxyz.map((value) => signed(value, 4)).join("  ");
    if (this.up) {
      const held = attitude(quaternion_wxyz, this.up);
      for (const name of ["heading", "pitch", "roll"]) shown(name).textContent = signed(held[name], 1);
    }
    this.#showAnswer(pose);
    this.#showUncertainty(pose);
    this.#showSpeed(pose, file || source === "photo");
    data.frame = String((this.#count += 1)); // last: who waits for it finds the rest in place
  }

  /** Say which of network and map answers, and how many matches agree; or which of several scenes it is. */
  #showAnswer({ source, map, scene, scene_probability }) {
    const row = document.getElementById("answer");
    row.hidden = map === undefined && scene === undefined;
    Object.assign(this.#element.dataset, { answer: source, inliers: map?.inliers ?? 0, scene: scene ?? "" });
    shown("answer").textContent = scene ?? source;
    const agree = map && `${map.inliers} of ${map.matches.length} matches agree`;
    const likely = scene && `${(100 * scene_probability).toFixed(0)} % likely`;
    shown("answer-detail").textContent = likely || agree || "no pose in the map";
    row.querySelector(".scale").hidden = source !== "map";
  }

  /** Show what most poses are within, where that is known, and whether the image is of the place at all. */
  #showUncertainty({ source, position_radius_m, rotation_radius_deg, unfamiliarity }) {
    const row = document.getElementById("uncertainty");
    row.hidden = position_radius_m === undefined;
    if (row.hidden) return;
    const [metres, degrees] = source === "map" ? [3, 2] : [2, 1];
    const isElsewhere = source === "network" && unfamiliarity > 1;
    row.dataset.within = String(!isElsewhere);
    shown("radius-position").textContent = `±${position_radius_m.toFixed(metres)} m`;
    shown("radius-rotation").textContent = `±${rotation_radius_deg.toFixed(degrees)}°`;
    shown("uncertainty-detail").textContent = isElsewhere ? "does not look like the place" : "";
  }

  /** Show how far the video's camera is from its true pose, and the median of the run so far. */
  showError(pose, truth, frame) {
    if (frame < this.#last) this.#errors = [];
    this.#last = frame;
    this.#element.dataset.filmFrame = String(frame);
    const { mm, deg } = deviation(pose, truth);
    this.#errors.push({ mm, deg });
    const [middleMm, middleDeg] = ["mm", "deg"].map((unit) => median(this.#errors.map((error) => error[unit])));
    const digits = pose.source === "map" ? 2 : 1;
    const frames = `${this.#errors.length} ${this.#errors.length === 1 ? "frame" : "frames"}`;
    this.#showErrors(
      "Error",
      `${(mm / 1000).toFixed(3)} m`,
      `${deg.toFixed(digits)}°`,
      `median of ${frames}: ${(middleMm / 1000).toFixed(3)} m, ${middleDeg.toFixed(digits)}°`,
    );
  }

  /** Show how far a test frame's pose is from the one that Python found. */
  showDeviation({ mm, deg, within, allowed }) {
    const limits = `allowed ${allowed.position_mm} mm, ${allowed.rotation_deg}°`;
    this.#showErrors(
      "From Python",
      `${small(mm, 3)} mm`,
      `${small(deg, 3)}°`,
      `${limits}: ${within ? "reproduced" : "not reproduced"}`,
      within,
    );
  }

  #showErrors(name, position, rotation, detail, within = "") {
    const row = document.getElementById("errors");
    row.hidden = false;
    row.dataset.within = String(within);
    document.getElementById("errors-name").textContent = name;
    shown("error-position").textContent = position;
    shown("error-rotation").textContent = rotation;
    shown("error-detail").textContent = detail;
  }

  #showSpeed(pose, single) {
    const now = performance.now();
    this.#times = [...this.#times.filter((time) => now - time < RATE_WINDOW_MS), now];
    this.#latencies = [...this.#latencies.slice(1 - LATENCIES), pose];
    const parts = ["preprocess_ms", "network_ms", "map_ms"].filter((part) => pose[part] !== undefined);
    const medians = parts.map((part) => median(this.#latencies.map((latency) => latency[part])));
    const intervals = this.#times.length - 1;
    const fps = (1000 * intervals) / (now - this.#times[0]);
    shown("fps").textContent = intervals > 1 && !single ? fps.toFixed(1) : "–";
    shown("latency").textContent = medians.reduce((a, b) => a + b).toFixed(1);
    shown("latency-detail").textContent = medians.map((each) => each.toFixed(1)).join(" + ");
    shown("latency-name").textContent = `Picture + network${parts.length > 2 ? " + map" : ""} (ms)`;
  }
}
