/** Poses from three points (Grunert 1841; Haralick and others 1994). */

import { cross, dot, minus, scaled, unit } from "./vectors.js";

/**
 * The poses, up to four, from which three points lie on three rays.
 * @param {number[][]} points in metres.
 * @param {number[][]} rays directions of unit length in the camera's axes.
 * @returns {{rotation: number[], position_m: number[]}[]} `world_from_cam`; none where the points lie on a line.
 */
export function posesOfThree(points, rays) {
  const [one, two, three] = points;
  const world = triad(minus(two, one), minus(three, one));
  if (!world) return [];
  const poses = [];
  for (const depths of depthsOfThree(points, rays)) {
    const seen = rays.map((ray, i) => scaled(ray, depths[i]));
    const camera = triad(minus(seen[1], seen[0]), minus(seen[2], seen[0]));
    if (!camera) continue;
    const rotation = [0, 1, 2].flatMap((row) =>
      [0, 1, 2].map((column) => world.reduce((sum, axis, i) => sum + axis[row] * camera[i][column], 0)),
    );
    const turned = [0, 3, 6].map((row) => dot(rotation.slice(row, row + 3), seen[0]));
    poses.push({ rotation, position_m: minus(one, turned) });
  }
  return poses;
}

/** Three axes at right angles, the first along one vector, the third across both; null where these are parallel. */
function triad(first, second) {
  const across = cross(first, second);
  if (!(dot(across, across) > 1e-12 * dot(first, first) * dot(second, second))) return null;
  const [x, z] = [unit(first), unit(across)];
  return [x, cross(z, x), z];
}

/** How far along their rays the points may be. The third depth over the first is a root of a quartic. */
function depthsOfThree([one, two, three], [ray1, ray2, ray3]) {
  const square = (vector) => dot(vector, vector);
  const [a, b, c] = [square(minus(two, three)), square(minus(one, three)), square(minus(one, two))];
  const [cosA, cosB, cosC] = [dot(ray2, ray3), dot(ray1, ray3), dot(ray1, ray2)];
  const [less, sum, ofA, ofC] = [(a - c) / b, (a + c) / b, a / b, c / b];
  const quartic = [
    (less - 1) ** 2 - 4 * ofC * cosA ** 2,
    4 * (less * (1 - less) * cosB - (1 - sum) * cosA * cosC + 2 * ofC * cosA ** 2 * cosB),
    2 * (less ** 2 - 1 + 2 * less ** 2 * cosB ** 2 + 2 * (1 - ofC) * cosA ** 2 - 4 * sum * cosA * cosB * cosC
      + 2 * (1 - ofA) * cosC ** 2),
    4 * (-less * (1 + less) * cosB + 2 * ofA * cosC ** 2 * cosB - (1 - sum) * cosA * cosC),
    (1 + less) ** 2 - 4 * ofA * cosC ** 2,
  ];
  const found = [];
  for (const third of realRoots(quartic)) {
    const second = ((less - 1) * third ** 2 - 2 * less * cosB * third + 1 + less) / (2 * (cosC - third * cosA));
    const first = Math.sqrt(b / (1 + third ** 2 - 2 * third * cosB));
    if (third > 0 && second > 0 && Number.isFinite(first * second)) found.push([first, first * second, first * third]);
  }
  return found;
}

/** Real roots of a quartic, highest power first, by Ferrari's method, and two steps of Newton's. */
function realRoots([lead, ...rest]) {
  const [b, c, d, e] = rest.map((each) => each / lead);
  // x = y - b/4 leaves y^4 + p y^2 + q y + r
  const p = c - (3 * b * b) / 8;
  const q = d - (b * c) / 2 + b ** 3 / 8;
  const r = e - (b * d) / 4 + (b * b * c) / 16 - (3 * b ** 4) / 256;
  const m = largestRoot(p, (p * p) / 4 - r, -(q * q) / 8); // (y^2 + p/2 + m)^2 is then a square
  if (!(m > 0)) return [];
  const slope = Math.sqrt(2 * m);
  const roots = [1, -1].flatMap((sign) => {
    const under = -(2 * p + 2 * m + (sign * 2 * q) / slope);
    if (!(under >= 0)) return [];
    return [1, -1].map((other) => (sign * slope + other * Math.sqrt(under)) / 2 - b / 4);
  });
  return roots.map((root) => {
    let x = root;
    for (let step = 0; step < 2; step++) {
      const descent = ((4 * x + 3 * b) * x + 2 * c) * x + d;
      if (descent) x -= ((((x + b) * x + c) * x + d) * x + e) / descent;
    }
    return x;
  });
}

/** The largest real root of x^3 + a x^2 + b x + c. */
function largestRoot(a, b, c) {
  const third = (a * a - 3 * b) / 9;
  const half = (2 * a ** 3 - 9 * a * b + 27 * c) / 54;
  if (half * half < third ** 3) {
    return 2 * Math.sqrt(third) * Math.cos(Math.acos(-half / third ** 1.5) / 3) - a / 3;
  }
  const big = -Math.sign(half) * Math.cbrt(Math.abs(half) + Math.sqrt(half * half - third ** 3));
  return big + (big ? third / big : 0) - a / 3;
}
