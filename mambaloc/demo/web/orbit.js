/** A camera on a sphere about a target: one finger turns it, two move it along and bring it closer. */

import { Spherical, Vector3 } from "./vendor/three/three.module.min.js";

const TURN = 0.006; // radians a pixel
const KEY_PIXELS = 24;
const MARGIN = 1.15;
const POLE = 0.05; // radians that the camera keeps from straight above and below

export class Orbit {
  #camera;
  #changed;
  #pointers = new Map();
  #sphere = new Spherical();
  #home = null;
  #size = 1;
  target = new Vector3();

  /**
   * @param camera of three.js; y is up.
   * @param {HTMLElement} element that is dragged.
   * @param {() => void} changed is called whenever the camera moved.
   */
  constructor(camera, element, changed) {
    this.#camera = camera;
    this.#changed = changed;
    element.addEventListener("pointerdown", (event) => {
      element.setPointerCapture(event.pointerId);
      this.#pointers.set(event.pointerId, event);
    });
    element.addEventListener("pointermove", (event) => this.#dragged(event));
    for (const end of ["pointerup", "pointercancel"]) {
      element.addEventListener(end, (event) => this.#pointers.delete(event.pointerId));
    }
    element.addEventListener("wheel", (event) => this.#wheeled(event), { passive: false });
    element.addEventListener("keydown", (event) => this.#pressed(event));
  }

  /** Look at a box from this direction, from where it just fills the view. */
  frame(box, theta, phi) {
    this.#home = [box, theta, phi];
    box.getCenter(this.target);
    this.#sphere.set(1, phi, theta);
    this.update();
    const away = this.#camera.quaternion.clone().invert();
    const steep = Math.tan((this.#camera.fov * Math.PI) / 360);
    let radius = 0;
    for (const x of [box.min.x, box.max.x]) {
      for (const y of [box.min.y, box.max.y]) {
        for (const z of [box.min.z, box.max.z]) {
          const corner = new Vector3(x, y, z).sub(this.target).applyQuaternion(away);
          const needed = Math.max(Math.abs(corner.x) / this.#camera.aspect, Math.abs(corner.y)) / steep;
          radius = Math.max(radius, MARGIN * needed + corner.z);
        }
      }
    }
    this.#size = this.#sphere.radius = radius || 1;
    this.update();
  }

  /** Go back to where {@link Orbit#frame} put the camera. */
  reset() {
    if (this.#home) this.frame(...this.#home);
  }

  /** Put the camera where the sphere says. */
  update() {
    this.#sphere.phi = Math.min(Math.PI - POLE, Math.max(POLE, this.#sphere.phi));
    this.#camera.position.setFromSpherical(this.#sphere).add(this.target);
    this.#camera.lookAt(this.target);
    this.#changed();
  }

  #turn(x, y) {
    this.#sphere.theta -= TURN * x;
    this.#sphere.phi -= TURN * y;
    this.update();
  }

  #zoom(factor) {
    this.#sphere.radius = Math.min(10 * this.#size, Math.max(0.05 * this.#size, this.#sphere.radius * factor));
    this.update();
  }

  #pan(x, y) {
    const scale = this.#sphere.radius * 0.0015;
    const [right, up] = [0, 1].map((axis) => new Vector3().setFromMatrixColumn(this.#camera.matrix, axis));
    this.target.addScaledVector(right, -scale * x).addScaledVector(up, scale * y);
    this.update();
  }

  #dragged(event) {
    const before = this.#pointers.get(event.pointerId);
    if (!before) return;
    const [x, y] = [event.clientX - before.clientX, event.clientY - before.clientY];
    const other = [...this.#pointers.values()].find((pointer) => pointer.pointerId !== event.pointerId);
    this.#pointers.set(event.pointerId, event);
    if (other) {
      const span = (pointer) => Math.hypot(pointer.clientX - other.clientX, pointer.clientY - other.clientY);
      this.#zoom(span(before) / Math.max(1, span(event)));
      this.#pan(x / 2, y / 2);
    } else if (event.shiftKey || event.buttons === 2) this.#pan(x, y);
    else this.#turn(x, y);
  }

  #wheeled(event) {
    event.preventDefault();
    this.#zoom(Math.exp(event.deltaY * (event.deltaMode ? 0.05 : 0.0015)));
  }

  #pressed(event) {
    const turns = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
    const zooms = { "+": 0.9, "=": 0.9, "-": 1.1 };
    if (turns[event.key]) this.#turn(...turns[event.key].map((sign) => sign * KEY_PIXELS));
    else if (zooms[event.key]) this.#zoom(zooms[event.key]);
    else return;
    event.preventDefault();
  }
}
