/** The page's side of the worker: promises instead of messages. */

const PATIENCE_MS = 30_000;

/** A running model. One at a time: {@link Engine#stop} the last before starting another. */
export class Engine {
  #worker = new Worker(new URL("worker.js", import.meta.url), { type: "module" });
  #waiting = new Map();
  #count = 0;

  /**
   * Load the model; where that fails or hangs, once more on one thread of WebAssembly, which runs everywhere.
   * @param {"auto"|"wasm"|"webgpu"} backend wanted; `info.backend` is the one that runs.
   * @param {(progress: {name: string, loaded: number, total: number}) => void} onProgress of the downloads.
   */
  static async start(backend, onProgress) {
    // WebKit's WebGPU may end the page in the middle of a network: only for those who ask.
    const wanted = backend === "auto" && navigator.vendor.startsWith("Apple") ? "wasm" : backend;
    try {
      return await Engine.#attempt({ backend: wanted }, onProgress);
    } catch (error) {
      const simplest = { backend: "wasm", threads: 1 };
      const engine = await Engine.#attempt(simplest, onProgress).catch(() => Promise.reject(error));
      engine.info.notes.push(`One thread of WebAssembly runs the model: ${error.message}`);
      return engine;
    }
  }

  static async #attempt(how, onProgress) {
    const engine = new Engine();
    try {
      engine.info = await engine.#started(how, onProgress);
    } catch (error) {
      engine.stop();
      throw error;
    }
    return engine;
  }

  /**
   * Localize a bitmap, which the worker takes.
   * @param {number[][]|null} intrinsics of it; the training camera's unless given.
   */
  localize(bitmap, intrinsics = null) {
    const id = (this.#count += 1);
    return new Promise((resolve, reject) => {
      this.#waiting.set(id, { resolve, reject });
      this.#worker.postMessage({ type: "localize", id, bitmap, intrinsics }, [bitmap]);
    });
  }

  stop() {
    this.#worker.terminate();
    this.#abandon(new Error("The model was stopped."));
  }

  #abandon(error) {
    for (const { reject } of this.#waiting.values()) reject(error);
    this.#waiting.clear();
  }

  #started(how, onProgress) {
    return new Promise((resolve, reject) => {
      let timer;
      const wait = () => {
        clearTimeout(timer);
        timer = setTimeout(() => reject(new Error("The model does not start; load the page again.")), PATIENCE_MS);
      };
      this.#worker.onerror = ({ message }) => {
        const error = new Error(`The model's worker failed (${message || "no reason given"}); load the page again.`);
        reject(error);
        this.#abandon(error);
      };
      this.#worker.onmessage = ({ data }) => {
        wait(); // from the last sign of life
        if (data.type !== "progress") clearTimeout(timer);
        if (data.type === "progress") onProgress(data);
        else if (data.type === "ready") resolve(data);
        else if (data.id === undefined) reject(new Error(data.message));
        else this.#settle(data);
      };
      wait();
      this.#worker.postMessage({ type: "start", ...how });
    });
  }

  #settle({ id, type, pose, message }) {
    const waiting = this.#waiting.get(id);
    this.#waiting.delete(id);
    if (type === "pose") waiting?.resolve(pose);
    else waiting?.reject(new Error(message));
  }
}
