// node replay.mjs MODULES WEB BUNDLE MODEL: the poses of the bundle's frames by the page's own module, as JSON.
import { readFile } from "node:fs/promises";
import { createRequire } from "node:module";
import { join } from "node:path";
import { pathToFileURL } from "node:url";

const [modules, web, bundle, model] = process.argv.slice(2);
const require = createRequire(join(modules, "replay.cjs"));
const ort = require("onnxruntime-node");
const { PNG } = require("pngjs");
const { Localizer } = await import(pathToFileURL(join(web, "localizer.js")));

const contract = JSON.parse(await readFile(join(bundle, "contract.json"), "utf8"));
const localizer = await Localizer.create(ort, await readFile(join(bundle, model)), contract);
const found = [];
for (const { file, intrinsics } of contract.frames) {
  const { data, width, height } = PNG.sync.read(await readFile(join(bundle, file)));
  found.push(await localizer.localize({ data, width, height, channels: 4 }, intrinsics));
}
console.log(JSON.stringify(found));
