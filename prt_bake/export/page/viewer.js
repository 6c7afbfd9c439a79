// The page: reads site.json, shows an object under a light, and says what it finds.
import * as THREE from "three";
import { OrbitControls } from "three/addons/controls/OrbitControls.js";
import { readAsset } from "./asset.js";
import { project, sun, turned } from "./light.js";
import { textureOf } from "./reflection.js";
import { Model } from "./shader.js";
import { Failure, readSky } from "./sky.js";

const $ = (id) => document.getElementById(id), number = (id) => Number($(id).value), say = window.say;
const canvas = $("view"), query = new URLSearchParams(location.search), scene = new THREE.Scene();
const camera = new THREE.PerspectiveCamera(), page = (window.prtbake = { scene, camera, frames: [], busy: () => lightChanged }); // what tests ask
const lights = [{ name: "sun", polar: async (degree) => sun(degree, toSun()) }];
const toSun = (angle = (number("height") * Math.PI) / 180) => [0, Math.cos(angle), Math.sin(angle)]; // in the polar frame
const pressed = (id) => $(id).ariaPressed === "true";
const TANGENT = Math.tan(Math.PI / 12); // of half the angle that the camera sees of the shorter side
const failing = (text) => (cause) => Promise.reject(new Failure(text, { cause }));
let renderer, controls, model, polar, objects = [], which = 0, lightChanged = false, viewChanged = false;
let opened = 0, shown = 0; // how often something was opened, and which of these objects is shown

async function start() {
  const lost = () => (renderer.setAnimationLoop(null), say("The graphics device was lost; reload the page."));
  renderer = new THREE.WebGPURenderer({ canvas, antialias: true, forceWebGL: query.get("backend") === "webgl" });
  renderer.onDeviceLost = lost;
  await renderer.init().catch(failing("This browser has neither WebGL 2 nor WebGPU; switch graphics acceleration on, or try a newer one."));
  renderer.backend.device?.lost.then(lost); // three.js does not tell when the reason is "destroyed", as after some crashes
  page.backend = renderer.backend.isWebGPUBackend ? "webgpu" : "webgl";
  bindControls();
  const answer = await get("site.json"), damaged = failing("site.json is damaged; export the page again.");
  const site = await answer.json().then((found) => found ?? damaged(), damaged);
  objects = site.objects ?? [];
  lights.unshift(...(site.lights ?? []).map(({ name, file }) => skyOf(name, async () => (await get(file)).arrayBuffer())));
  listLights();
  $("next").hidden = objects.length < 2;
  if (!objects.length) throw new Failure("The page has no object; drop one on it, .h5 or .glb.");
  await showObject(Number(query.get("object")));
}

async function get(file) {
  const answer = await fetch(file).catch(() => ({}));
  if (!answer.ok) throw new Failure(`${file} is missing on the server; export the page again.`);
  return answer;
}

/** A light that reads its picture when it is first shown, and keeps its coefficients of each degree. */
function skyOf(name, load) {
  let picture;
  const forget = (cause) => { picture = undefined; throw cause; }; // so that the next choice reads it again
  const known = [], read = () => load().then((bytes) => named(name, () => readSky(new Uint8Array(bytes))));
  const polar = async (degree) => known[degree] ??= project(degree, await (picture ??= read().catch(forget)));
  return { name, polar, prepare: async function () { this.texture ??= textureOf(await picture); } };
}

async function showObject(number) {
  const { name, file, from } = objects.at((which = number % objects.length || 0)), began = performance.now(), order = ++opened;
  say(`Loading ${name} …`);
  await open(new Uint8Array(await (await get(file)).arrayBuffer()), name, order, from);
  page.opened = performance.now() - began;
}

/** Show an asset, or light the object by a sky. Of objects, the one that was opened last stays. */
async function open(bytes, name, order, from) {
  const kind = String.fromCharCode(...bytes.subarray(0, 4)), isSky = kind.startsWith("#?") || kind === "v/1\x01";
  const read = { "\x89HDF": readAsset, glTF: async (bytes) => (await import("./glb.js")).readGlb(bytes) }[kind];
  if (isSky) await addLight(skyOf(name, async () => bytes));
  else await named(name, async () => {
    if (!bytes.length) throw new Failure("is empty; copy it again.");
    if (!read) throw new Failure("is neither an asset (.h5, .glb) nor a sky (.hdr, .exr).");
    await show(await read(bytes), name, bytes.length, order, from);
  });
  say("");
  if (model) await attempt(relight);
  if (isSky && model?.record.quantity === "radiance") say(`${name} lights the next object; the light of this one cannot change.`);
}

/** Run what may fail because of a file, and name the file in what is then said. */
const named = (name, work) => work().catch((error) => {
  throw new Failure(`${name} ${error instanceof Failure ? error.message : `cannot be shown: ${error.message}`}`, { cause: error });
});

async function addLight(sky) {
  await sky.polar(2); // a picture that cannot be read does not become a light
  lights.unshift(sky);
  listLights();
}

async function show(record, name, size, order, from) {
  const { faces, positions, K, quantity, selftest } = record, fixed = quantity === "radiance", next = new Model(renderer, record);
  const off = await next.selftest(), met = off < 1e-3, reflects = Math.abs(record.eta - 1) > 1e-9;
  if (order < shown) return next.dispose();
  shown = order;
  model?.dispose();
  scene.clear().add((model = next).mesh);
  model.mesh.visible = false; // until it has a light
  Object.assign(page, { model, renderer, selftest: off });
  const counts = `${(faces.length / 3).toLocaleString("en")} triangles · ${(positions.length / 3).toLocaleString("en")} vertices`;
  $("name").textContent = name;
  $("figures").textContent = `${counts} · ${(size / 1e6).toPrecision(3)} MB`;
  $("error").textContent = `Error: ${record.error}.`;
  const why = selftest.vertex.length ? "fails its self-test: another program changed the file, or this device computes wrongly" : "has no self-test";
  $("check").textContent = met ? "meets its self-test" : why;
  $("about").className = met ? "" : "bad";
  const missing = [reflects && (fixed ? "light reflected at the surface" : "the object in its own reflection"), ...record.missing].filter(Boolean);
  const light = fixed ? "The light is that of the bake." : `Light is ${K} coefficients, so narrow light looks soft.`;
  $("left-out").textContent = `${missing.length ? `Not shown: ${missing.join(", ")}. ` : ""}${light}`;
  for (const id of ["light-row", "turn-row", "drag"]) $(id).hidden = fixed;
  $("reflection").hidden = !reflects;
  $("about").hidden = false;
  frameObject(from);
}

function frameObject(direction = [0.43, 0.24, 0.87]) {
  const { geometry } = model.mesh, up = model.record.up === "z" ? [0, 0, 1] : [0, 1, 0];
  geometry.computeBoundingSphere();
  const { center, radius } = geometry.boundingSphere, away = (1.15 * radius) / Math.sin(Math.atan(TANGENT));
  const [x, y, z] = direction, from = new THREE.Vector3(...(up[2] ? [x, -z, y] : [x, y, z]));
  camera.up.set(...up);
  camera.position.copy(center).addScaledVector(from, away);
  Object.assign(camera, { near: radius / 100, far: 100 * radius });
  controls?.dispose();
  controls = Object.assign(new OrbitControls(camera, canvas), { enableDamping: true, dampingFactor: 0.12, enablePan: false });
  controls.listenToKeyEvents(canvas);
  Object.assign(controls, { keyRotateSpeed: 10, minDistance: 1.05 * radius, maxDistance: 20 * radius, target: center.clone() });
  controls.addEventListener("change", () => (viewChanged = true));
  resize();
}

/** Light the object by the chosen light; the newest choice wins. */
async function relight() {
  const light = lights[number("light")], { record } = model, fixed = record.quantity === "radiance";
  $("height-row").hidden = fixed || light.name !== "sun";
  const found = fixed ? [1, 1, 1] : await light.polar(Math.sqrt(record.K) - 1).catch((cause) => bySun(light, cause));
  const reflected = !fixed && pressed("reflection") && !$("reflection").hidden ? light : null;
  await reflected?.prepare?.();
  if (light !== lights[number("light")] || record !== model.record) return;
  model.reflect(pressed("reflection") ? reflected : null);
  [polar, lightChanged] = [found, true];
  say("");
}

/** Where a light cannot be read, choose the sun, which needs no file, and say why. */
async function bySun(light, cause) {
  if (light === lights[number("light")]) ($("light").value = lights.length - 1), await relight();
  throw cause;
}

function frame() {
  if (!model) return;
  const began = performance.now();
  controls.update();
  if (lightChanged) {
    const [x, y, z] = toSun();
    model.setLight((page.light = turned(polar, model.record.up, number("turn"))));
    model.reflection.turn(number("turn"));
    model.reflection.toSun.value.set(x, z, y);
    model.mesh.visible = true;
  }
  if (!lightChanged && !viewChanged) return;
  lightChanged = viewChanged = false;
  model.exposure.value = 2 ** number("exposure");
  model.eye.value.set(...camera.position, 1);
  renderer.render(scene, camera);
  page.frames = [...page.frames.slice(-99), performance.now() - began];
}

function resize() {
  const { clientWidth: width, clientHeight: height } = canvas;
  renderer.setPixelRatio(Math.min(2, devicePixelRatio));
  renderer.setSize(width, height, false);
  camera.aspect = width / height;
  camera.fov = (360 / Math.PI) * Math.atan(TANGENT / Math.min(1, camera.aspect));
  camera.setViewOffset(width, height, 0, (document.querySelector("footer").offsetHeight - 40) / 2, width, height); // above the controls
  viewChanged = true;
}

function listLights() {
  $("light").replaceChildren(...lights.map(({ name }, i) => new Option(name, i)));
}

/** Run what may fail, and say why it did. */
async function attempt(work) {
  try {
    await work();
  } catch (error) {
    console.warn(error);
    say(error.message);
  }
}

function bindControls() {
  const openAll = (files, order = ++opened) => (page.work = attempt(async () => {
    for (const file of files) say(`Loading ${file.name} …`), await open(new Uint8Array(await file.arrayBuffer()), file.name, order);
  }));
  const toggle = (id) => ($(id).ariaPressed = !pressed(id));
  const turnsLight = (event) => event.isPrimary && (event.shiftKey || event.button === 2 || pressed("drag")); // two fingers zoom
  let turning = false;
  const sizes = new ResizeObserver(resize);
  for (const part of [canvas, document.querySelector("footer")]) sizes.observe(part);
  renderer.setAnimationLoop(frame);
  $("turn").oninput = () => (lightChanged = Boolean(polar));
  $("exposure").oninput = () => (viewChanged = true);
  $("light").onchange = $("height").oninput = () => attempt(relight);
  $("next").onclick = () => (page.work = attempt(() => showObject(which + 1)));
  $("next-light").onclick = () => ($("light").value = (number("light") + 1) % lights.length, attempt(relight));
  $("drag").onclick = () => toggle("drag");
  $("reflection").onclick = () => (toggle("reflection"), (page.work = attempt(relight)));
  $("file").onchange = () => openAll([...$("file").files]);
  document.ondragover = (event) => event.preventDefault();
  document.ondrop = (event) => (event.preventDefault(), openAll([...event.dataTransfer.files]));
  canvas.addEventListener("pointerdown", (event) => {
    turning = turnsLight(event);
    if (controls && event.isPrimary) controls.enableRotate = !turning;
  }, true);
  canvas.onpointermove = (event) => {
    if (!turning || !event.buttons) return;
    $("turn").value = ((number("turn") + 0.4 * event.movementX + 540) % 360) - 180;
    $("height").value = number("height") - 0.3 * event.movementY;
    attempt(relight);
  };
  canvas.onpointerup = canvas.onpointercancel = () => (turning = false);
}

page.ready = attempt(start);
