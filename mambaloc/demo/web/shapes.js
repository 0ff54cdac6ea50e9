/** What moves in the view: cameras and the trail of estimates. */

import * as THREE from "./vendor/three/three.module.min.js";

const SPREAD = 0.55; // half the image plane's width at depth 1: about 58 degrees, a phone's; only for the eye
const TRAIL = 90;
const ROD = new THREE.CylinderGeometry(1, 1, 1, 6);
const ALONG = new THREE.Vector3(0, 1, 0);

/** A camera as a pyramid with its image on the far side. Lives in the scene's frame, with OpenCV's axes. */
export class Camera {
  #depth;
  #aspect = 0;
  #struts = new THREE.Group();
  #picture = null;
  #material = new THREE.MeshBasicMaterial();
  group = new THREE.Group();

  /**
   * @param {number} depth of the pyramid in metres.
   * @param texture of the image; without one the camera stays a wire frame.
   */
  constructor(depth, texture = null) {
    this.#depth = depth;
    this.group.add(this.#struts);
    if (texture) {
      const material = new THREE.MeshBasicMaterial({ map: texture, side: THREE.DoubleSide, toneMapped: false });
      this.#picture = new THREE.Mesh(new THREE.PlaneGeometry(2, 2), material);
      this.#picture.rotation.x = Math.PI; // the plane's y is up, the camera's is down
      this.#picture.position.z = depth;
      this.group.add(this.#picture);
    }
  }

  place({ position_m, quaternion_wxyz: [w, x, y, z] }, aspect = 4 / 3) {
    if (aspect !== this.#aspect) this.#shape(aspect);
    this.group.position.set(...position_m);
    this.group.quaternion.set(x, y, z, w).normalize();
    this.group.visible = true;
  }

  paint(colour) {
    this.#material.color.copy(colour);
  }

  #shape(aspect) {
    this.#aspect = aspect;
    const [right, down, forward] = [SPREAD, SPREAD / aspect, 1].map((value) => value * this.#depth);
    this.#picture?.scale.set(right, down, 1);
    const at = ([x, y]) => new THREE.Vector3(x * right, y * down, forward);
    const corners = [[-1, -1], [1, -1], [1, 1], [-1, 1]].map(at);
    const centre = new THREE.Vector3();
    const top = at([0, -1.35]); // a roof says which side of the image is up
    const edges = corners.flatMap((corner, i) => [[centre, corner], [corner, corners[(i + 1) % 4]]]);
    edges.push([corners[0].clone().lerp(corners[1], 0.3), top], [corners[0].clone().lerp(corners[1], 0.7), top]);
    this.#struts.clear();
    for (const [from, to] of edges) this.#struts.add(new Rod(0.018 * this.#depth, this.#material).lay(from, to).mesh);
  }
}

/** Where the scene's x, y and z point. */
export class Axes {
  group = new THREE.Group();

  constructor(length) {
    for (const axis of [[1, 0, 0], [0, 1, 0], [0, 0, 1]]) {
      const end = new THREE.Vector3(...axis).multiplyScalar(length);
      this.group.add(new Rod(0.03 * length).lay(new THREE.Vector3(), end).mesh);
    }
  }

  paint(colours) {
    this.group.children.forEach((mesh, i) => mesh.material.color.copy(colours[i]));
  }
}

/** The last estimates as dots that fade. */
export class Trail {
  #positions = new THREE.BufferAttribute(new Float32Array(3 * TRAIL), 3);
  #colours = new THREE.BufferAttribute(new Float32Array(4 * TRAIL), 4);
  #count = 0;
  points;

  constructor() {
    const geometry = new THREE.BufferGeometry();
    geometry.setAttribute("position", this.#positions);
    geometry.setAttribute("color", this.#colours);
    const material = new THREE.PointsMaterial({
      size: 7,
      sizeAttenuation: false,
      map: dot(),
      vertexColors: true,
      transparent: true,
      depthWrite: false,
    });
    this.points = new THREE.Points(geometry, material);
    this.points.frustumCulled = false;
    this.clear();
  }

  add(position) {
    const positions = this.#positions.array;
    positions.copyWithin(3, 0, 3 * (TRAIL - 1)); // newest first
    positions.set(position, 0);
    this.#positions.needsUpdate = true;
    this.#count = Math.min(TRAIL, this.#count + 1);
    this.points.geometry.setDrawRange(0, this.#count);
  }

  clear() {
    this.#count = 0;
    this.points.geometry.setDrawRange(0, 0);
  }

  paint({ r, g, b }) {
    for (let i = 0; i < TRAIL; i++) this.#colours.setXYZW(i, r, g, b, 0.9 * (1 - i / TRAIL) ** 1.5);
    this.#colours.needsUpdate = true;
  }
}

/** Points of the scene, all of them or those that are chosen. */
export class Cloud {
  #points;

  constructor(positions, size, parent) {
    const geometry = new THREE.BufferGeometry();
    geometry.setAttribute("position", new THREE.BufferAttribute(Float32Array.from(positions), 3));
    geometry.setIndex(new THREE.BufferAttribute(Uint32Array.from({ length: positions.length / 3 }, (_, i) => i), 1));
    const material = new THREE.PointsMaterial({ size, sizeAttenuation: false, map: dot(), alphaTest: 0.5 });
    this.#points = new THREE.Points(geometry, material);
    this.#points.frustumCulled = false;
    parent.add(this.#points);
  }

  choose(rows) {
    this.#points.geometry.index.array.set(rows);
    this.#points.geometry.index.needsUpdate = true;
    this.#points.geometry.setDrawRange(0, rows.length);
  }

  paint(colour) {
    this.#points.material.color.copy(colour);
  }

  remove() {
    this.#points.removeFromParent();
    this.#points.geometry.dispose();
    this.#points.material.dispose();
  }
}

/** A thin rod; WebGL's own lines are one pixel wide, which no phone shows well. */
export class Rod {
  #radius;
  mesh;

  constructor(radius, material = new THREE.MeshBasicMaterial()) {
    this.#radius = radius;
    this.mesh = new THREE.Mesh(ROD, material);
  }

  lay(from, to) {
    const along = to.clone().sub(from);
    this.mesh.scale.set(this.#radius, along.length(), this.#radius);
    this.mesh.position.copy(from).addScaledVector(along, 0.5);
    this.mesh.quaternion.setFromUnitVectors(ALONG, along.normalize());
    return this;
  }
}

/** A path through poses. */
export function tube(poses, radius) {
  const points = poses.map(([x, y, z]) => new THREE.Vector3(x, y, z));
  const apart = points.filter((point, i) => i === 0 || point.distanceTo(points[i - 1]) > 1e-6);
  const material = new THREE.MeshBasicMaterial();
  if (apart.length < 2) return new THREE.Mesh(new THREE.BufferGeometry(), material);
  const curve = new THREE.CatmullRomCurve3(apart);
  curve.arcLengthDivisions = 2 * apart.length;
  return new THREE.Mesh(new THREE.TubeGeometry(curve, 2 * apart.length, radius, 5), material);
}

function dot() {
  const canvas = Object.assign(document.createElement("canvas"), { width: 32, height: 32 });
  const context = canvas.getContext("2d");
  context.fillStyle = "white";
  context.arc(16, 16, 15, 0, 2 * Math.PI);
  context.fill();
  return new THREE.CanvasTexture(canvas);
}
