/** The scene in 3-D: where the training camera went, and where this one is. */

import * as THREE from "./vendor/three/three.module.min.js";
import { poseOf, upOf } from "./geometry.js";
import { Orbit } from "./orbit.js";
import { Axes, Camera, Cloud, Rod, Trail, tube } from "./shapes.js";

const UP = new THREE.Vector3(0, 1, 0);
const VIEWPOINT = { theta: 0.6, phi: 1.0 }; // radians about "up", and from it
const FALLBACK_UP = [0, 0, 1];
const PICTURE_WIDTH = 320;

export class View {
  #canvas;
  #renderer;
  #scene = new THREE.Scene();
  #camera = new THREE.PerspectiveCamera(40, 1, 0.01, 1000);
  #world = new THREE.Group(); // the scene's frame; turned so that its "up" is three.js's y
  #paths = new THREE.Group();
  #sequences;
  #furniture = new THREE.Group();
  #orbit;
  #asked = false;
  #grid = null;
  #axes;
  #estimate;
  #truth;
  #trail;
  #gap;
  #map = null; // its points, and those that agree with the pose
  #seen = null;
  #truePath = null;
  #picture = Object.assign(document.createElement("canvas"), { width: PICTURE_WIDTH, height: PICTURE_WIDTH });
  #texture = new THREE.CanvasTexture(this.#picture);
  #bounds;
  follows = false;
  /** A unit vector in the scene's frame, or null where no training poses say. */
  up = null;
  /** Metres between the grid's lines. */
  gridStep;

  /**
   * @param {HTMLCanvasElement} canvas to draw on; throws where there is no WebGL.
   * @param {Object<string, number[][]>} sequences of `trajectory.json`; none is fine.
   */
  constructor(canvas, sequences) {
    this.#canvas = canvas;
    this.#renderer = new THREE.WebGLRenderer({ canvas, antialias: true, alpha: true });
    this.#orbit = new Orbit(this.#camera, canvas, () => this.#ask());
    this.#texture.colorSpace = THREE.SRGBColorSpace;
    this.up = upOf(Object.values(sequences).flat().map(poseOf));
    this.#world.quaternion.setFromUnitVectors(new THREE.Vector3(...(this.up ?? FALLBACK_UP)), UP);
    this.#scene.add(this.#world);
    this.#world.add(this.#paths);
    this.#world.updateMatrixWorld(true);
    this.#sequences = sequences;
    this.#bounds = boundsOf(sequences, this.#world);
    for (const poses of Object.values(sequences)) this.#paths.add(tube(poses, 0.004 * this.#bounds.radius));
    this.#furnish();
    this.paint();
    canvas.addEventListener("webglcontextrestored", () => this.#ask());
    new ResizeObserver(() => this.#resize()).observe(canvas);
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.paint());
  }

  /** Show the video's true path too; null hides it. */
  showTruePath(poses) {
    if (this.#truePath) {
      this.#world.remove(this.#truePath);
      this.#truePath.geometry.dispose();
      this.#truePath.material.dispose();
    }
    this.#truePath = poses && tube(poses, 0.004 * this.#bounds.radius);
    if (this.#truePath) this.#world.add(this.#truePath);
    this.paint();
  }

  /**
   * Show a map's points, and stand where they are seen, too; null hides them.
   * @param {Float64Array|null} points x, y, z one after another.
   */
  showMap(points) {
    this.#bounds = boundsOf(this.#sequences, this.#world, points);
    this.#furnish();
    for (const cloud of [this.#map, this.#seen]) cloud?.remove();
    this.#map = points && new Cloud(points, 2, this.#world);
    this.#seen = points && new Cloud(points, 4, this.#world);
    this.#seen?.choose([]);
    if (this.#canvas.dataset.framed) this.#orbit.frame(this.#bounds.box, VIEWPOINT.theta, VIEWPOINT.phi);
    this.paint();
  }

  /**
   * Keep the image that the next pose is of.
   * @param {CanvasImageSource} source
   */
  setPicture(source, width, height) {
    const scaled = Math.round((PICTURE_WIDTH * height) / width);
    if (this.#picture.height !== scaled) {
      this.#picture.height = scaled;
      this.#texture.dispose(); // its size is fixed once it is on the GPU
    }
    this.#picture.getContext("2d").drawImage(source, 0, 0, PICTURE_WIDTH, scaled);
  }

  /** Show where the camera is, and where it truly is if that is known. */
  show(pose, truth = null) {
    this.#texture.needsUpdate = true;
    this.#estimate.place(pose, this.#picture.width / this.#picture.height);
    this.#trail.add(pose.position_m);
    const agreeing = pose.source === "map" ? pose.map.matches.filter(({ off }) => off <= 1) : [];
    this.#seen?.choose(agreeing.map(({ point }) => point));
    this.#truth.group.visible = this.#gap.mesh.visible = Boolean(truth);
    if (truth) {
      this.#truth.place(truth);
      this.#gap.lay(...[pose, truth].map(({ position_m }) => new THREE.Vector3(...position_m)));
    }
    if (this.follows) {
      this.#orbit.target.copy(this.#world.localToWorld(new THREE.Vector3(...pose.position_m)));
      this.#orbit.update();
    }
    this.#ask();
  }

  /** Forget the camera and its trail. */
  clear() {
    this.#trail.clear();
    this.#seen?.choose([]);
    this.#estimate.group.visible = this.#truth.group.visible = this.#gap.mesh.visible = false;
    this.#ask();
  }

  /** Stand where everything is seen. */
  reset() {
    this.#orbit.reset();
  }

  /** Take the colours from the style sheet, which knows light from dark. */
  paint() {
    const style = getComputedStyle(this.#canvas);
    const colour = (name) => new THREE.Color(style.getPropertyValue(name).trim());
    this.#paths.children.forEach((path, i) => path.material.color.copy(colour(`--path-${(i % 4) + 1}`)));
    this.#estimate.paint(colour("--estimate"));
    this.#truth.paint(colour("--truth"));
    this.#truePath?.material.color.copy(colour("--truth"));
    this.#gap.mesh.material.color.copy(colour("--ink"));
    this.#map?.paint(colour("--cloud"));
    this.#seen?.paint(colour("--estimate"));
    this.#trail.paint(colour("--estimate"));
    this.#axes.paint(["--x", "--y", "--z"].map(colour));
    this.#grid.material.color.copy(colour("--grid"));
    this.#ask();
  }

  /** Everything that is not a training path or a map, at a size that suits them. */
  #furnish() {
    const { radius, centre, floor, depth } = this.#bounds;
    this.#furniture.clear();
    this.#grid?.removeFromParent();
    this.gridStep = niceStep(radius / 2);
    const cells = 2 * Math.ceil((1.3 * radius) / this.gridStep);
    this.#grid = new THREE.GridHelper(cells * this.gridStep, cells, "white", "white");
    this.#grid.material.vertexColors = false;
    this.#grid.position.set(centre.x, floor, centre.z);
    this.#scene.add(this.#grid);
    this.#axes = new Axes(0.5 * this.gridStep);
    this.#axes.group.position.copy(this.#world.worldToLocal(this.#grid.position.clone()));
    this.#estimate = new Camera(depth, this.#texture);
    this.#truth = new Camera(0.6 * depth);
    this.#trail = new Trail();
    this.#gap = new Rod(0.004 * radius);
    this.#furniture.add(this.#axes.group, this.#truth.group, this.#estimate.group, this.#trail.points, this.#gap.mesh);
    this.#world.add(this.#furniture);
    this.clear();
  }

  #resize() {
    const { clientWidth: width, clientHeight: height } = this.#canvas;
    if (!width || !height) return;
    const first = !this.#canvas.dataset.framed;
    this.#renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
    this.#renderer.setSize(width, height, false);
    this.#camera.aspect = width / height;
    this.#camera.updateProjectionMatrix();
    if (first) {
      this.#orbit.frame(this.#bounds.box, VIEWPOINT.theta, VIEWPOINT.phi);
      this.#canvas.dataset.framed = "true";
    }
    this.#draw();
  }

  /** Draw before the next refresh; a view that nothing happens in costs nothing. */
  #ask() {
    if (this.#asked) return;
    this.#asked = true;
    requestAnimationFrame(() => this.#draw());
  }

  #draw() {
    this.#asked = false;
    this.#renderer.render(this.#scene, this.#camera);
  }
}

/**
 * The box that the training cameras and the map's points stay in, with "up" along y; a few metres where there are none.
 * And its centre and radius, the floor's height, and how deep to draw a camera.
 */
function boundsOf(sequences, world, points = null) {
  const box = new THREE.Box3();
  for (const [x, y, z] of Object.values(sequences).flat()) {
    box.expandByPoint(world.localToWorld(new THREE.Vector3(x, y, z)));
  }
  if (box.isEmpty()) box.set(new THREE.Vector3(-1, -0.5, -1), new THREE.Vector3(1, 0.5, 1));
  const { radius: path } = box.getBoundingSphere(new THREE.Sphere());
  const floor = points ? 0 : 0.35 * path;
  if (points) box.union(middleOf(points, world));
  const { center, radius } = box.getBoundingSphere(new THREE.Sphere());
  const depth = Math.max(0.2 * path, 0.1 * radius, 0.01);
  return { box, centre: center, radius: Math.max(radius, 0.05), floor: box.min.y - floor, depth };
}

/** The box of all points but the outermost fiftieth at each end of each axis: a few lie far off. */
function middleOf(points, world) {
  const places = Array.from({ length: points.length / 3 }, (_, i) =>
    world.localToWorld(new THREE.Vector3(points[3 * i], points[3 * i + 1], points[3 * i + 2])),
  );
  const box = new THREE.Box3();
  for (const axis of ["x", "y", "z"]) {
    const sorted = places.map((place) => place[axis]).sort((a, b) => a - b);
    const margin = Math.floor(sorted.length / 50);
    [box.min[axis], box.max[axis]] = [sorted[margin], sorted.at(-1 - margin)];
  }
  return box;
}

/** 1, 2 or 5 times a power of ten, at most `size`. */
function niceStep(size) {
  const power = 10 ** Math.floor(Math.log10(size));
  return [5, 2, 1].find((step) => step * power <= size) * power;
}
