/** The bundle's test frames: does this browser find the poses that PyTorch found? */

import { deviation } from "./localiser.js";
import { small } from "./readout.js";

export class TestFrames {
  #list;
  #verdict;
  #frames;
  #allowed;
  #localise;

  /**
   * @param {HTMLElement} list to fill with a button for each frame.
   * @param {HTMLElement} verdict on all of them.
   * @param {object} contract of the bundle.
   * @param {object} allowed deviation: `position_mm` and `rotation_deg`.
   * @param {(frame: object) => Promise<object|null>} localise one of the contract's frames; null if that failed.
   */
  constructor(list, verdict, contract, allowed, localise) {
    this.#list = list;
    this.#verdict = verdict;
    this.#frames = contract.frames;
    this.#allowed = allowed;
    this.#localise = localise;
    list.replaceChildren(...this.#frames.map((frame, i) => this.#button(frame, i)));
    verdict.textContent = "Does this browser find what PyTorch found?";
    delete verdict.dataset.within;
  }

  /** Localise every frame, and say how far the worst is from PyTorch's pose. */
  async checkAll() {
    const found = [];
    for (const frame of this.#frames) {
      const one = await this.#take(frame);
      if (!one) return;
      found.push(one);
    }
    const { position_mm, rotation_deg } = this.#allowed;
    const [mm, deg] = ["mm", "deg"].map((unit) => Math.max(...found.map((one) => one[unit])));
    const within = mm <= position_mm && deg <= rotation_deg;
    this.#verdict.dataset.within = String(within);
    this.#verdict.textContent =
      `${within ? "Yes" : "No"}: ${small(mm, 3)} mm and ${small(deg, 3)}° at worst over ${found.length} frames; ` +
      `${position_mm} mm and ${rotation_deg}° are allowed.`;
  }

  async #take(frame) {
    for (const button of this.#list.children) {
      button.setAttribute("aria-pressed", String(button.dataset.frameFile === frame.file));
    }
    const pose = await this.#localise(frame);
    if (!pose) return null;
    const found = deviation(pose, frame);
    this.#list.children[this.#frames.indexOf(frame)].lastChild.textContent = `${small(found.mm, 3).replace(" ", "")} mm`;
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
