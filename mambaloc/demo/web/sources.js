/** Where images come from: a video, the camera, or a file. */

/** Pixels as the file has them, without colour management, as in training. EXIF's orientation is honoured anyway. */
const AS_STORED = { colorSpaceConversion: "none", premultiplyAlpha: "none" };

/** A bitmap of an image file. */
export async function decoded(blob, name) {
  try {
    return await createImageBitmap(blob, AS_STORED);
  } catch {
    throw new Error(`${name} is not an image that this browser can read. Give a JPEG or PNG.`);
  }
}

/** JSON beside the page, or null where there is none. */
export async function optionalJson(path) {
  const response = await fetch(path).catch(() => null);
  return response?.ok ? response.json().catch(() => null) : null; // a host may answer with a page instead
}

/** Hands out a video's frames one after another, and never one while another is worked on. */
export class Stream {
  #video;
  #take;
  #request = 0;
  #stopped = false;
  #newest = -1;

  /**
   * @param {HTMLVideoElement} video
   * @param {(bitmap: ImageBitmap, seconds: number) => Promise<void>} take what to do with a frame; the next one waits.
   */
  constructor(video, take) {
    this.#video = video;
    this.#take = take;
    this.#next();
  }

  stop() {
    this.#stopped = true;
    if (this.#video.cancelVideoFrameCallback) this.#video.cancelVideoFrameCallback(this.#request);
    else cancelAnimationFrame(this.#request);
  }

  #next() {
    if (this.#stopped) return;
    if (this.#video.requestVideoFrameCallback) {
      this.#request = this.#video.requestVideoFrameCallback((_, { mediaTime }) => this.#step(mediaTime));
    } else {
      this.#request = requestAnimationFrame(() => this.#step(this.#video.currentTime));
    }
  }

  async #step(seconds) {
    const video = this.#video;
    if (seconds !== this.#newest && video.readyState >= HTMLMediaElement.HAVE_CURRENT_DATA && video.videoWidth) {
      this.#newest = seconds;
      const bitmap = await createImageBitmap(video, AS_STORED).catch(() => null); // null: the source just went away
      if (bitmap && this.#stopped) bitmap.close();
      else if (bitmap) await this.#take(bitmap, seconds);
    }
    this.#next();
  }
}

/** The bundled film, and its true poses where they are known. */
export class Film {
  #url = null;

  /** @param {{file: string, fps?: number, poses?: number[][]}} description `film.json` */
  constructor({ file, fps, poses = null }) {
    this.file = file;
    this.fps = fps;
    this.poses = poses;
  }

  /** Whether this browser says that it may play such a file. */
  static plays(file) {
    const type = { webm: 'video/webm; codecs="vp8"', mp4: "video/mp4" }[file.split(".").at(-1)];
    return !type || document.createElement("video").canPlayType(type) !== "";
  }

  /** Of the whole video in memory: it can then be wound back whatever server it is from. */
  async url() {
    if (!this.#url) {
      const response = await fetch(this.file).catch(() => null);
      if (!response?.ok) throw new Error("The video cannot be fetched: choose another source.");
      this.#url = URL.createObjectURL(await response.blob());
    }
    return this.#url;
  }

  /** The number of the frame that is shown at this time. A frame's own time may be rounded to a millisecond. */
  frameAt(seconds) {
    return Math.min(this.poses.length - 1, Math.max(0, Math.floor(seconds * this.fps + 0.02)));
  }
}

/** Ask for the camera that looks away from the user. */
export async function openCamera() {
  if (!navigator.mediaDevices?.getUserMedia) {
    throw new Error("The camera needs HTTPS: start the server with --lan and open the address that it prints.");
  }
  const video = { facingMode: { ideal: "environment" }, width: { ideal: 640 }, height: { ideal: 480 } };
  try {
    return await navigator.mediaDevices.getUserMedia({ video, audio: false });
  } catch (error) {
    throw new Error(CAMERA_ERRORS[error.name] ?? `The camera cannot be opened (${error.message || error.name}).`);
  }
}

const CAMERA_ERRORS = {
  NotAllowedError: "The camera was not allowed: allow it in the browser's site settings, then choose Camera again.",
  NotFoundError: "This device has no camera: choose a photo instead.",
  NotReadableError: "Another program holds the camera: close it, then choose Camera again.",
};
