// node drift.mjs WEB < POSES: where the page's Drift carries them, as JSON.
import { readFileSync } from "node:fs";
import { join } from "node:path";
import { pathToFileURL } from "node:url";

const { Drift } = await import(pathToFileURL(join(process.argv[2], "drift.js")));
const { keyPoses, weights, nugget, poses } = JSON.parse(readFileSync(0, "utf8"));
const drift = new Drift(keyPoses, weights, nugget);
console.log(JSON.stringify(poses.map((pose) => ({ given: drift.toGiven(pose), adjusted: drift.toAdjusted(pose) }))));
