/**
 * The network, off the page's thread.
 *
 * Is sent `{type: "start", backend}` once, then `{type: "localise", id, bitmap}`. Answers with `progress`, `ready`,
 * `pose` and `error`.
 */

import { Localiser, checkContract, modelOf } from "./localiser.js";

const HERE = new URL("./", import.meta.url);
const VENDOR = new URL("vendor/onnxruntime-web/", HERE);
const BACKENDS = {
  wasm: { library: "ort.wasm.min.mjs", binary: "ort-wasm-simd-threaded.wasm" },
  webgpu: { library: "ort.webgpu.min.mjs", binary: "ort-wasm-simd-threaded.asyncify.wasm" },
};
const MAX_THREADS = 4;
const ERRORS_ONLY = 3;

let localiser = null;
let context = null;

self.onmessage = async ({ data }) => {
  try {
    if (data.type === "start") self.postMessage({ type: "ready", ...(await start(data.backend)) });
    else self.postMessage({ type: "pose", id: data.id, pose: await localiser.localise(pixels(data.bitmap)) });
  } catch (error) {
    self.postMessage({ type: "error", id: data.id, message: error.message });
  }
};

async function start(wanted) {
  const contract = JSON.parse(new TextDecoder().decode(await fetched("bundle/contract.json")));
  checkContract(contract);
  const file = modelOf(contract);
  const model = await fetched(`bundle/${file}`, "model");
  const verified = await checkDigest(file, model, contract.files[file].sha256);
  const adapter = await webgpuAdapter();
  // An adapter that is imitated on the CPU is slower than WebAssembly: only for those who ask.
  const preferred = wanted === "webgpu" || (wanted !== "wasm" && !adapter?.info?.isFallbackAdapter);
  const info = { contract, verified, webgpu: Boolean(adapter), note: "" };
  if (adapter && preferred) {
    try {
      return { ...info, ...(await open("webgpu", model, contract)) };
    } catch (error) {
      info.note = `WebAssembly runs the model, for WebGPU cannot here: ${firstLine(error)}`;
    }
  } else if (wanted === "webgpu") {
    info.note = "This browser offers no WebGPU, so WebAssembly runs the model.";
  }
  return { ...info, ...(await open("wasm", model, contract)) };
}

/** Load one backend, and let the model localise a grey picture: a backend that cannot says so here. */
async function open(backend, model, contract) {
  const { library, binary } = BACKENDS[backend];
  const ort = await import(new URL(library, VENDOR));
  const threads = self.crossOriginIsolated ? Math.min(MAX_THREADS, navigator.hardwareConcurrency || 1) : 1;
  ort.env.wasm.numThreads = threads;
  ort.env.wasm.wasmPaths = VENDOR.href;
  ort.env.wasm.wasmBinary = await fetched(new URL(binary, VENDOR), "runtime");
  ort.env.logLevel = "error";
  const options = { executionProviders: [backend], logSeverityLevel: ERRORS_ONLY };
  const opened = await Localiser.create(ort, model, contract, options);
  await opened.localise(grey(contract.preprocessing.crop));
  localiser = opened;
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

/** The bitmap's RGBA bytes; the bitmap is closed. */
function pixels(bitmap) {
  const { width, height } = bitmap;
  if (context?.canvas.width !== width || context.canvas.height !== height) {
    context = new OffscreenCanvas(width, height).getContext("2d", { willReadFrequently: true });
  }
  context.globalCompositeOperation = "copy";
  context.drawImage(bitmap, 0, 0);
  bitmap.close();
  return { data: context.getImageData(0, 0, width, height).data, width, height, channels: 4 };
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

/** Refuse a model that is not the one that its contract was written with. False: a page without HTTPS cannot tell. */
async function checkDigest(file, bytes, expected) {
  if (!self.crypto?.subtle) return false;
  const digest = new Uint8Array(await self.crypto.subtle.digest("SHA-256", bytes));
  const found = Array.from(digest, (byte) => byte.toString(16).padStart(2, "0")).join("");
  if (found !== expected) {
    throw new Error(
      `${file} is not the file that its contract was written with (sha256 ${found.slice(0, 12)}…, not ` +
        `${expected.slice(0, 12)}…); get the bundle anew.`,
    );
  }
  return true;
}

function firstLine(error) {
  return String(error?.message ?? error).split("\n", 1)[0];
}
