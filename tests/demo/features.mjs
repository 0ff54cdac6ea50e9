// node features.mjs WEB FOLDER: grey images and keypoints that the page's modules make of FOLDER's images.
import { readFile, writeFile } from "node:fs/promises";
import { join } from "node:path";
import { pathToFileURL } from "node:url";

const [web, folder] = process.argv.slice(2);
const { greyPicture } = await import(pathToFileURL(join(web, "pictures.js")));
const { detectFeatures } = await import(pathToFileURL(join(web, "sift.js")));
const cases = JSON.parse(await readFile(join(folder, "cases.json"), "utf8"));
for (const [number, { width, height, scale }] of cases.entries()) {
  const data = new Uint8Array(await readFile(join(folder, `${number}.rgb`)));
  const grey = greyPicture({ data, width, height }, scale);
  const { pixels, descriptors } = detectFeatures(grey);
  await writeFile(join(folder, `${number}.grey`), grey.values);
  await writeFile(join(folder, `${number}.pixels`), pixels);
  await writeFile(join(folder, `${number}.descriptors`), descriptors);
}
