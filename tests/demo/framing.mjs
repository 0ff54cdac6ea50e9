// node framing.mjs WEB < CASES: how the page's module resizes images, and the cameras that models are fed, as JSON.
import { readFileSync } from "node:fs";
import { join } from "node:path";
import { pathToFileURL } from "node:url";

const { cameraOfLens, framing } = await import(pathToFileURL(join(process.argv[2], "framing.js")));
const cases = JSON.parse(readFileSync(0, "utf8"));
const found = cases.map(({ image, contract, intrinsics, lens_mm }) => {
  try {
    const { preprocessing, camera } = framing(image, contract, lens_mm ? cameraOfLens(image, lens_mm) : intrinsics);
    return { short_side: preprocessing.short_side, camera };
  } catch ({ message }) {
    return { message };
  }
});
console.log(JSON.stringify(found));
