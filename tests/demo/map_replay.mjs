// node map_replay.mjs MODULES WEB MAP PICTURE...: where the page's modules localise pictures in a map, as JSON.
import { readFile } from "node:fs/promises";
import { createRequire } from "node:module";
import { join } from "node:path";
import { pathToFileURL } from "node:url";

const [modules, web, map, ...pictures] = process.argv.slice(2);
const { PNG } = createRequire(join(modules, "replay.cjs"))("pngjs");
const { MapLocaliser } = await import(pathToFileURL(join(web, "map_localiser.js")));
const { readMap } = await import(pathToFileURL(join(web, "sparse_map.js")));
const localiser = new MapLocaliser(readMap(new Uint8Array(await readFile(map))));
const found = [];
for (const picture of pictures) {
  const { data, width, height } = PNG.sync.read(await readFile(picture));
  found.push(localiser.localise({ data, width, height }));
}
console.log(JSON.stringify(found));
