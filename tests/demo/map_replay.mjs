// node map_replay.mjs MODULES WEB MAP IMAGE...: where the page's modules localize images in a map, as JSON; and on
// the error stream the median CPU time of an image, decoding left out, once the first ones have warmed the compiler up.
import { readFile } from "node:fs/promises";
import { createRequire } from "node:module";
import { join } from "node:path";
import { pathToFileURL } from "node:url";

const [modules, web, map, ...pictures] = process.argv.slice(2);
const { PNG } = createRequire(join(modules, "replay.cjs"))("pngjs");
const { MapLocalizer } = await import(pathToFileURL(join(web, "map_localizer.js")));
const { readMap } = await import(pathToFileURL(join(web, "sparse_map.js")));
const localizer = new MapLocalizer(readMap(new Uint8Array(await readFile(map))));
const [found, cpu_ms] = [[], []];
for (const picture of pictures) {
  const { data, width, height } = PNG.sync.read(await readFile(picture));
  const start = process.cpuUsage();
  found.push(localizer.localize({ data, width, height }));
  const { user, system } = process.cpuUsage(start);
  cpu_ms.push((user + system) / 1000);
}
const warm = cpu_ms.slice(cpu_ms.length >> 1).sort((a, b) => a - b);
console.error(`${warm[warm.length >> 1]?.toFixed(0)} ms of CPU time a picture`);
console.log(JSON.stringify(found));
