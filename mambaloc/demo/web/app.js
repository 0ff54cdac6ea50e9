/** The page: what is chosen, what runs, what is shown. */

import { describe } from "./about.js";
import { Engine } from "./engine.js";
import { TestFrames, deviations } from "./frames.js";
import { poseOf } from "./geometry.js";
import { askForLens, outlineCrop, statedCamera } from "./lens.js";
import { drawMatches } from "./matches.js";
import { Readout } from "./readout.js";
import { Film, Stream, decoded, openCamera, optionalJson } from "./sources.js";
import { View } from "./view.js";

const STILL_PIXELS = 1024; // of a still's longer side on the page; the model is given them all
const $ = (id) => document.getElementById(id);
const query = new URLSearchParams(location.search);
const calm = matchMedia("(prefers-reduced-motion: reduce)").matches;

let engine = null;
let contract = null;
let view = null;
let readout = null;
let frames = null;
let film = null;
let stream = null;
let source = "";
let photo = null; // the last one, for another lens
let visit = 0; // counts choices of a source; what an earlier one still answers is dropped

async function main() {
  const files = ["bundle/trajectory.json", "film.json"];
  const [trajectory, description] = await Promise.all(files.map(optionalJson));
  const sequences = trajectory?.sequences ?? {};
  openView(sequences);
  readout = new Readout(view?.up ?? null);
  if (description && Film.plays(description.file)) film = new Film(description);
  $("film-note").textContent = film?.poses ? "A video whose true poses are known." : "";
  $("offer-film").hidden = !film;
  document.querySelector(".key .path").hidden = !Object.keys(sequences).length;
  listen();
  await load(query.get("backend") ?? "auto");
}

/** Load the model, and go on with the source that is chosen, or the best there is. */
async function load(backend) {
  await startEngine(backend);
  const wanted = source || query.get("source");
  const offered = ["camera", "photo", "frames", ...(film ? ["film"] : [])];
  await choose(offered.includes(wanted) ? wanted : offered.at(-1));
}

function openView(sequences) {
  try {
    view = new View($("scene"), sequences);
    $("grid-step").textContent = `grid ${view.gridStep} m`;
    setFollowing(!Object.keys(sequences).length); // nothing else says where to look
  } catch {
    document.querySelector(".view").classList.add("flat");
    $("flat").hidden = false;
  }
}

function listen() {
  for (const input of document.querySelectorAll('[name="source"]')) {
    // Not "change": what failed may be chosen again.
    input.addEventListener("click", () => {
      if (input.value !== source || document.body.dataset.state === "error") choose(input.value);
    });
  }
  for (const input of document.querySelectorAll('[name="backend"]')) {
    input.addEventListener("change", () => changeBackend(input.value));
  }
  $("photo").addEventListener("change", ({ target }) => takeFile(target.files[0]));
  $("photo").addEventListener("click", ({ target }) => (target.value = "")); // the same file may be chosen again
  $("focal").addEventListener("change", () => source === "photo" && takeFile(photo));
  addEventListener("dragover", (event) => event.preventDefault());
  addEventListener("drop", (event) => {
    event.preventDefault();
    takeFile(event.dataTransfer.files[0]);
  });
  $("play").addEventListener("click", () => ($("video").paused ? $("video").play() : $("video").pause()));
  for (const event of ["play", "pause"]) $("video").addEventListener(event, showPlaying);
  $("video").addEventListener("error", ({ target }) => {
    if (target.hasAttribute("src")) fail(new Error("This browser cannot play the video: choose another source."));
  });
  $("check").addEventListener("click", async ({ target }) => {
    target.disabled = true;
    await frames?.checkAll();
    target.disabled = false;
  });
  $("reset").addEventListener("click", () => view?.reset());
  $("follow").addEventListener("click", () => setFollowing(!view.follows));
}

function setFollowing(follows) {
  view.follows = follows;
  $("follow").setAttribute("aria-pressed", String(follows));
}

function showPlaying() {
  const { paused } = $("video");
  $("play").textContent = paused ? "Play" : "Pause";
  if (source === "film" && stream && paused && document.body.dataset.state === "running") setState("ready", "Paused");
}

/** Start the model on the backend that is wanted, or the one that works; `engine` stays null if none does. */
async function startEngine(backend) {
  setState("loading", "Loading…");
  $("loading").hidden = false;
  $("backends").disabled = true;
  try {
    engine = await Engine.start(backend, showProgress);
  } catch (error) {
    return fail(error);
  } finally {
    $("loading").hidden = true;
    $("backends").disabled = false;
  }
  const { info } = engine;
  contract = info.contract;
  document.body.dataset.backend = info.backend;
  readout.offset = contract.world?.offset_m ?? [0, 0, 0];
  $("model-line").textContent = `${contract.model} · ${contract.scene}`;
  $("wasm-name").textContent = info.backend === "wasm" ? `WASM, ${threads(info.threads)}` : "WASM";
  for (const input of document.querySelectorAll('[name="backend"]')) {
    input.checked = input.value === info.backend;
    if (input.value === "webgpu") input.disabled = !info.webgpu;
  }
  $("sideways").textContent = `Hold the phone sideways${contract.intrinsics ? ", or say what lens it has" : ""}. `;
  $("sideways").hidden = contract.preprocessing.crop[1] <= contract.preprocessing.short_side;
  note(info.notes.join(" "));
  view?.showMap(info.mapPoints);
  document.querySelector(".key .points").hidden = !info.mapPoints;
  describe($("about"), contract, info.verified);
  frames = new TestFrames($("frames"), $("verdict"), contract, takeFrame);
  setState("ready", "Ready");
}

async function changeBackend(backend) {
  leave();
  engine?.stop();
  engine = null;
  await load(backend);
}

/** Leave the source that is on, and go to another. */
async function choose(name) {
  source = name;
  if (!engine) return; // until the model is there
  leave();
  const turn = visit;
  document.querySelector(`[name="source"][value="${name}"]`).checked = true;
  for (const control of document.querySelectorAll(".control")) control.hidden = control.dataset.for !== name;
  askForLens(name, contract.intrinsics || engine.info.mapPoints);
  const truePath = name === "film" ? film.poses : null;
  document.querySelector(".key .truth").hidden = !truePath;
  view?.showTruePath(truePath);
  setState("ready", { photo: "Choose a photo", frames: "Choose a frame" }[name] ?? "Starting…");
  try {
    if (name === "film") await startFilm(turn);
    if (name === "camera") await startCamera(turn);
  } catch (error) {
    if (turn === visit) fail(error);
  }
}

function leave() {
  visit += 1;
  stream?.stop();
  stream = null;
  const video = $("video");
  video.pause();
  for (const track of video.srcObject?.getTracks() ?? []) track.stop();
  video.srcObject = null;
  video.removeAttribute("src");
  video.load();
  for (const id of ["video", "still", "crop", "error"]) $(id).hidden = true;
  drawMatches($("matches"), []);
  view?.clear();
  readout.restart();
}

async function startFilm(turn) {
  const url = await film.url();
  if (turn !== visit) return;
  const video = $("video");
  video.loop = true;
  video.src = url;
  video.hidden = false;
  startStream(film.poses && ((seconds) => film.frameAt(seconds)));
  if (!calm) await video.play().catch(() => {}); // the browser may want a tap first
  if (video.paused && document.body.dataset.state !== "error") setState("ready", "Press Play");
}

async function startCamera(turn) {
  const media = await openCamera();
  if (turn !== visit) return media.getTracks().forEach((track) => track.stop());
  const video = $("video");
  video.srcObject = media;
  video.hidden = false;
  media.getVideoTracks()[0].addEventListener("ended", () => {
    if (turn === visit) fail(new Error("The camera went away: choose Camera again."));
  });
  await video.play();
  startStream();
}

/** Localize frame after frame. `frameAt` gives the number of a frame whose true pose is known. */
function startStream(frameAt = null) {
  const turn = visit;
  stream = new Stream($("video"), async (bitmap, seconds) => {
    try {
      const frame = frameAt?.(seconds);
      const truth = frameAt && poseOf(film.poses[frame]);
      const pose = await localize(bitmap, truth, statedCamera(source, bitmap));
      if (turn !== visit) return;
      if (truth) readout.showError(pose, truth, frame);
      readout.show(pose, source);
      if (!$("video").paused) setState("running", "Running");
    } catch (error) {
      if (turn === visit) fail(error);
    }
  });
}

/**
 * Localize one image and show where it was taken; null if another source was chosen meanwhile.
 * @param truth pose, where that is known.
 * @param {number[][]|null} intrinsics of the image; the training camera's unless given.
 */
async function localize(bitmap, truth = null, intrinsics = null) {
  const turn = visit;
  try {
    view?.setPicture(bitmap, bitmap.width, bitmap.height);
    outlineCrop(bitmap, contract, intrinsics);
  } catch (error) {
    bitmap.close();
    throw error;
  }
  const pose = await engine.localize(bitmap, intrinsics);
  if (turn === visit) {
    $("error").hidden = true;
    drawMatches($("matches"), pose.source === "map" ? pose.map.matches : []);
    view?.show(pose, truth);
  }
  return pose;
}

/** Localize an image that does not move. */
async function localizeStill(blob, name, frame = null) {
  const turn = visit;
  try {
    const bitmap = await decoded(blob, name);
    if (turn !== visit) {
      bitmap.close();
      return null;
    }
    const shrunk = Math.min(1, STILL_PIXELS / Math.max(bitmap.width, bitmap.height));
    const [width, height] = [bitmap.width, bitmap.height].map((side) => Math.max(1, Math.round(side * shrunk)));
    const canvas = Object.assign($("still"), { width, height, hidden: false });
    canvas.getContext("2d").drawImage(bitmap, 0, 0, width, height);
    const pose = await localize(bitmap, null, frame ? frame.intrinsics : statedCamera(source, bitmap));
    if (turn !== visit) return null;
    if (frame) readout.showDeviation(deviations(pose, frame, contract).at(-1));
    else readout.forgetErrors();
    readout.show(pose, source, frame?.file);
    setState("ready", "Localized");
    return pose;
  } catch (error) {
    if (turn === visit) fail(error);
    return null;
  }
}

async function takeFile(file) {
  if (!file || !engine) return;
  photo = file;
  if (source !== "photo") await choose("photo");
  await localizeStill(file, file.name);
}

async function takeFrame(frame) {
  const turn = visit;
  const response = await fetch(`bundle/${frame.file}`).catch(() => null);
  const blob = response?.ok ? await response.blob().catch(() => null) : null;
  if (turn !== visit) return null;
  if (blob) return localizeStill(blob, frame.file, frame);
  fail(new Error(`${frame.file} cannot be fetched; is the server still running?`));
  return null;
}

function showProgress({ name, loaded, total }) {
  const bar = $("progress");
  const megabytes = (bytes) => (bytes / 1e6).toFixed(1);
  bar.previousElementSibling.textContent =
    `Loading the ${name}, ${megabytes(loaded)}${total ? ` of ${megabytes(total)}` : ""} MB`;
  if (total) Object.assign(bar, { max: total, value: loaded });
  else bar.removeAttribute("value");
}

function setState(state, text) {
  document.body.dataset.state = state;
  if ($("status").textContent !== text) $("status").textContent = text;
}

function fail(error) {
  if ($("error").hidden || $("error").textContent !== error.message) $("error").textContent = error.message;
  $("error").hidden = false;
  drawMatches($("matches"), []);
  view?.clear();
  setState("error", "No pose");
}

function note(text) {
  $("note").textContent = text;
  $("note").hidden = !text;
}

function threads(count) {
  return `${count} ${count === 1 ? "thread" : "threads"}`;
}

main().catch(fail);
