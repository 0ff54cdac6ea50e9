// node preprocess.mjs WEB FOLDER: what the page's module makes of FOLDER's images, raw bytes in and floats out.
import { readFile, writeFile } from "node:fs/promises";
import { join } from "node:path";
import { pathToFileURL } from "node:url";

const [web, folder] = process.argv.slice(2);
const { Preprocessor } = await import(pathToFileURL(join(web, "pictures.js")));
const cases = JSON.parse(await readFile(join(folder, "cases.json"), "utf8"));
for (const [number, { width, height, preprocessing }] of cases.entries()) {
  const data = new Uint8Array(await readFile(join(folder, `${number}.rgb`)));
  const planes = new Preprocessor().apply({ data, width, height, channels: 3 }, preprocessing);
  await writeFile(join(folder, `${number}.f32`), planes);
}
