/** The bundle's test frames: does this browser find the poses that Python found? */

import { deviation, modelOf } from "./localizer.js";
import { small } from "./readout.js";

/**
 * How far the network's pose of a test frame is from the one in the contract, and after it, where the map has one, the
 * map's.
 * @returns {{name: string, mm: number, deg: number, allowed: object, within: boolean}[]}
 */
export function deviations(pose, frame, contract) {
  const pairs = [["network", pose.network, frame, contract.files[modelOf(contract)].allowed]];
  if (pose.map !== undefined && frame.map) pairs.push(["map", pose.map, frame.map, contract.map.allowed]);
  return pairs.map(([name, found, expected, allowed]) => {
    const { mm, deg } = found ? deviation(found, expected) : { mm: Infinity, deg: Infinity };
    return { name, mm, deg, allowed, within: mm <= allowed.position_mm && deg <= allowed.rotation_deg };
  });
}

export class TestFrames {
  #list;
  #verdict;
  #contract;
  #localize;

  /**
   * @param {HTMLElement} list to fill with a button for each frame.
   * @param {HTMLElement} verdict on all of them.
   * @param {object} contract of the bundle.
   * @param {(frame: object) => Promise<object|null>} localize one of the contract's frames; null if that failed.
   */
  constructor(list, verdict, contract, localize) {
    this.#list = list;
    this.#verdict = verdict;
    this.#contract = contract;
    this.#localize = localize;
    list.replaceChildren(...contract.frames.map((frame, i) => this.#button(frame, i)));
    verdict.textContent = "Does this browser find what Python found?";
    delete verdict.dataset.within;
  }

  /** Localize every frame, and say how far the worst is from Python's pose. */
  async checkAll() {
    const found = [];
    for (const frame of this.#contract.frames) {
      const one = await this.#take(frame);
      if (!one) return;
      found.push(...one);
    }
    const said = ["network", "map"].flatMap((name) => {
      const own = found.filter((one) => one.name === name);
      if (!own.length) return [];
      const [mm, deg] = ["mm", "deg"].map((unit) => small(Math.max(...own.map((one) => one[unit])), 3));
      const { position_mm, rotation_deg } = own[0].allowed;
      const limits = `${position_mm} mm and ${rotation_deg}° are allowed`;
      return [`${name} ${mm} mm and ${deg}° at worst over ${own.length} frames; ${limits}`];
    });
    const within = found.every((one) => one.within);
    this.#verdict.dataset.within = String(within);
    this.#verdict.textContent = `${within ? "Yes" : "No"}:\n${said.join(".\n")}.`;
  }

  async #take(frame) {
    for (const button of this.#list.children) {
      button.setAttribute("aria-pressed", String(button.dataset.frameFile === frame.file));
    }
    const pose = await this.#localize(frame);
    if (!pose) return null;
    const found = deviations(pose, frame, this.#contract);
    const button = this.#list.children[this.#contract.frames.indexOf(frame)];
    button.lastChild.textContent = `${small(found.at(-1).mm, 3).replace(" ", "")} mm`;
    return found;
  }

  #button(frame, i) {
    const button = Object.assign(document.createElement("button"), { type: "button" });
    button.dataset.frameFile = frame.file;
    button.setAttribute("aria-pressed", "false");
    button.append(
      Object.assign(new Image(), { src: `bundle/${frame.file}`, alt: `Test frame ${i + 1}` }),
      document.createElement("span"),
    );
    button.addEventListener("click", () => this.#take(frame));
    return button;
  }
}
