/**
 * Network and map, off the page's thread.
 *
 * Is sent `{type: "start", backend, threads}` once, then `{type: "localize", id, bitmap, intrinsics}`. Answers with
 * `progress`, `ready`, `pose` and `error`.
 */

import { Localizer, checkContract, modelOf } from "./localizer.js";
import { readMap } from "./sparse_map.js";

const HERE = new URL("./", import.meta.url);
const VENDOR = new URL("vendor/onnxruntime-web/", HERE);
const BACKENDS = {
  wasm: { library: "ort.wasm.min.mjs", binary: "ort-wasm-simd-threaded.wasm" },
  webgpu: { library: "ort.webgpu.min.mjs", binary: "ort-wasm-simd-threaded.asyncify.wasm" },
};
const MAP = "map.safetensors";
const MAX_THREADS = 4;
const STRIP_PIXELS = 2 ** 22; // iOS gives black, and no error, for canvases of more than 2^24
const ERRORS_ONLY = 3;

let localizer = null;
let context = null;

self.onmessage = async ({ data }) => {
  try {
    if (data.type === "start") self.postMessage({ type: "ready", ...(await start(data)) });
    else {
      const pose = await localizer.localize(pixels(data.bitmap), data.intrinsics);
      self.postMessage({ type: "pose", id: data.id, pose });
    }
  } catch (error) {
    self.postMessage({ type: "error", id: data.id, message: error.message });
  }
};

async function start({ backend: wanted, threads }) {
  if (!self.OffscreenCanvas) throw new Error("This browser is too old to read images here; update it.");
  const contract = JSON.parse(new TextDecoder().decode(await fetched("bundle/contract.json")));
  checkContract(contract);
  const file = modelOf(contract);
  const model = await fetched(`bundle/${file}`, "model");
  const verified = await checkDigest(file, model, contract.files[file].sha256);
  const { map, notes } = await openMap(contract);
  const adapter = await webgpuAdapter();
  // An adapter that is imitated on the CPU is slower than WebAssembly: only for those who ask.
  const preferred = wanted === "webgpu" || (wanted !== "wasm" && !adapter?.info?.isFallbackAdapter);
  const info = { contract, verified, webgpu: Boolean(adapter), notes, mapPoints: map?.points_m ?? null };
  if (adapter && preferred) {
    try {
      return { ...info, ...(await open("webgpu", model, contract, map, threads)) };
    } catch (error) {
      notes.push(`WebAssembly runs the model, for WebGPU cannot here: ${firstLine(error)}`);
    }
  } else if (wanted === "webgpu") {
    notes.push("This browser offers no WebGPU, so WebAssembly runs the model.");
  }
  return { ...info, ...(await open("wasm", model, contract, map, threads)) };
}

/** The bundle's map; null where it has none, and where it cannot be used, which a note then says. */
async function openMap(contract) {
  if (!(MAP in contract.files)) return { map: null, notes: [] };
  try {
    const bytes = await fetched(`bundle/${MAP}`, "map");
    await checkDigest(MAP, bytes, contract.files[MAP].sha256);
    return { map: readMap(bytes), notes: [] };
  } catch (error) {
    return { map: null, notes: [`${firstLine(error)} The network answers without the map.`] };
  }
}

/** Load one backend, and let the model localize a grey image: a backend that cannot says so here. */
async function open(backend, model, contract, map, most) {
  const { library, binary } = BACKENDS[backend];
  const ort = await import(new URL(library, VENDOR));
  const cores = self.crossOriginIsolated ? navigator.hardwareConcurrency || 1 : 1;
  const threads = Math.min(most ?? MAX_THREADS, cores);
  ort.env.wasm.numThreads = threads;
  ort.env.wasm.wasmPaths = VENDOR.href;
  ort.env.wasm.wasmBinary = await fetched(new URL(binary, VENDOR), "runtime");
  ort.env.logLevel = "error";
  const options = { executionProviders: [backend], logSeverityLevel: ERRORS_ONLY };
  const opened = await Localizer.create(ort, model, contract, map, options);
  await opened.localize(grey(contract.preprocessing.crop));
  localizer = opened;
  return { backend, threads };
}

async function webgpuAdapter() {
  try {
    return (await navigator.gpu?.requestAdapter()) ?? null;
  } catch {
    return null;
  }
}

function grey([height, width]) {
  return { data: new Uint8Array(height * width * 3).fill(127), width, height, channels: 3 };
}

/** The bitmap's RGBA bytes, read strip by strip; the bitmap is closed. */
function pixels(bitmap) {
  const { width, height } = bitmap;
  const rows = Math.min(height, Math.max(1, Math.floor(STRIP_PIXELS / width)));
  if (context?.canvas.width !== width || context.canvas.height !== rows) {
    context = new OffscreenCanvas(width, rows).getContext("2d", { willReadFrequently: true });
    context.globalCompositeOperation = "copy";
  }
  const data = new Uint8ClampedArray(4 * width * height);
  try {
    for (let top = 0; top < height; top += rows) {
      const count = Math.min(rows, height - top);
      context.drawImage(bitmap, 0, top, width, count, 0, 0, width, count);
      data.set(context.getImageData(0, 0, width, count).data, 4 * width * top);
    }
  } finally {
    bitmap.close();
  }
  refuseTransparent(data);
  return { data, width, height, channels: 4 };
}

/** A canvas multiplies colours by their opacity, which cannot be undone; in training opacity was dropped. */
function refuseTransparent(data) {
  for (let i = 3; i < data.length; i += 4) {
    if (data[i] !== 255) throw new Error("The image has transparent parts: save it as a JPEG, and choose that.");
  }
}

/** A file's bytes; says how far it is, if it is named. */
async function fetched(path, name = "") {
  const url = new URL(path, HERE);
  const response = await fetch(url).catch(() => null);
  if (!response?.ok) {
    const reason = response ? `status ${response.status}` : "no answer";
    throw new Error(`${url.pathname} cannot be fetched (${reason}); is the server still running?`);
  }
  const total = response.headers.has("Content-Encoding") ? 0 : Number(response.headers.get("Content-Length"));
  const chunks = [];
  let loaded = 0;
  for (const reader = response.body.getReader(); ; ) {
    const { done, value } = await reader.read();
    if (done) break;
    chunks.push(value);
    loaded += value.length;
    if (name) self.postMessage({ type: "progress", name, loaded, total });
  }
  return new Uint8Array(await new Blob(chunks).arrayBuffer());
}

/** Refuse a model that is not the one that its contract was written with. False: a page without HTTPS cannot check. */
async function checkDigest(file, bytes, expected) {
  if (!self.crypto?.subtle) return false;
  const digest = new Uint8Array(await self.crypto.subtle.digest("SHA-256", bytes));
  const found = Array.from(digest, (byte) => byte.toString(16).padStart(2, "0")).join("");
  if (found !== expected) {
    throw new Error(
      `${file} is not the file that its contract was written with (sha256 ${found.slice(0, 12)}…, not ` +
        `${expected.slice(0, 12)}…); get the bundle again.`,
    );
  }
  return true;
}

function firstLine(error) {
  return String(error?.message ?? error).split("\n", 1)[0];
}
