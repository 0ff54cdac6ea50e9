// node preprocess.mjs LOCALISER FOLDER: what the page's module makes of FOLDER's pictures, raw bytes in and floats out.
import { readFile, writeFile } from "node:fs/promises";
import { join } from "node:path";
import { pathToFileURL } from "node:url";

const [localiserFile, folder] = process.argv.slice(2);
const { preprocess } = await import(pathToFileURL(localiserFile));
const cases = JSON.parse(await readFile(join(folder, "cases.json"), "utf8"));
for (const [number, { width, height, preprocessing }] of cases.entries()) {
  const data = new Uint8Array(await readFile(join(folder, `${number}.rgb`)));
  const planes = preprocess({ data, width, height, channels: 3 }, preprocessing);
  await writeFile(join(folder, `${number}.f32`), planes);
}
