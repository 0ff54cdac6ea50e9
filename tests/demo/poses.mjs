// node poses.mjs WEB < PROBLEMS: what the page's solvers find, as JSON.
import { readFileSync } from "node:fs";
import { join } from "node:path";
import { pathToFileURL } from "node:url";

const load = (name) => import(pathToFileURL(join(process.argv[2], name)));
const { focalScale, ransacPose, refinePose } = await load("absolute_pose.js");
const { LEAST_PROBABILITY, MOST_DEVIATION, isAnotherFocalLength, probabilityOf } = await load("acceptance.js");
const { posesOfThree } = await load("three_points.js");
const { three, many, evidence } = JSON.parse(readFileSync(0, "utf8"));
const found = {
  three: three.map(({ points, rays }) => posesOfThree(points, rays)),
  many: many.map(({ points, rays, near, start }) => {
    const [flatPoints, flatRays] = [points, rays].map((rows) => Float64Array.from(rows.flat()));
    const refined = start && refinePose(start, flatPoints, flatRays, near);
    const focal = refined && focalScale(refined.pose, flatPoints, flatRays, near);
    const isAnother = focal && isAnotherFocalLength(focal);
    return { ransac: ransacPose(flatPoints, flatRays, near, 0), refined, focal, isAnother };
  }),
  probabilities: evidence.map((each) => probabilityOf(...each)),
  least: LEAST_PROBABILITY,
  most: MOST_DEVIATION,
};
console.log(JSON.stringify(found));
