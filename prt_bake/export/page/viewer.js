// The page: reads site.json, shows an object under a light, and says what it finds.
import * as THREE from "three";
import { OrbitControls } from "three/addons/controls/OrbitControls.js";
import { readAsset } from "./asset.js";
import { project, sun, turned } from "./light.js";
import { Model } from "./shader.js";
import { Failure, openSky } from "./sky.js";

const $ = (id) => document.getElementById(id), number = (id) => Number($(id).value), say = window.say;
const canvas = $("view"), query = new URLSearchParams(location.search), scene = new THREE.Scene();
const camera = new THREE.PerspectiveCamera(30), page = (window.prtbake = { scene, frames: [], busy: () => lightChanged }); // what tests ask
const lights = [{ name: "sun", polar: async (degree) => sun(degree, number("height")) }];
const failing = (text) => (cause) => Promise.reject(new Failure(text, { cause }));
let renderer, controls, model, objects = [], shown = 0, polar = null, lightChanged = false, viewChanged = false;

async function start() {
  const lost = () => (renderer.setAnimationLoop(null), say("The graphics device was lost; reload the page."));
  renderer = new THREE.WebGPURenderer({ canvas, antialias: true, forceWebGL: query.get("backend") === "webgl" });
  renderer.onDeviceLost = lost;
  await renderer.init().catch(failing("This browser has neither WebGL 2 nor WebGPU; switch graphics acceleration on, or try a newer one."));
  renderer.backend.device?.lost.then(lost); // three.js does not tell when the reason is "destroyed", as after some crashes
  page.backend = renderer.backend.isWebGPUBackend ? "webgpu" : "webgl";
  bindControls();
  const site = await (await get("site.json")).json().catch(failing("site.json is damaged; export the page again."));
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
  const known = [], parse = async (bytes, degree) => project(degree, await openSky(new Uint8Array(bytes)));
  const read = async (degree) => load().then((bytes) => named(name, () => parse(bytes, degree)));
  return { name, polar: (degree) => (known[degree] ??= read(degree)) };
}

async function showObject(which) {
  const { name, file } = objects.at((shown = which % objects.length || 0)), began = performance.now();
  say(`Loading ${name} …`);
  await open(new Uint8Array(await (await get(file)).arrayBuffer()), name);
  page.opened = performance.now() - began;
}

/** Show an asset, or light the object by a sky. */
async function open(bytes, name) {
  const kind = String.fromCharCode(...bytes.subarray(0, 4)), isSky = kind.startsWith("#?") || kind === "v/1\x01";
  if (isSky) await addLight(skyOf(name, async () => bytes));
  else await named(name, async () => {
    if (kind === "\x89HDF") await show(await readAsset(bytes), name, bytes.length);
    else if (kind === "glTF") await show(await (await import("./glb.js")).readGlb(bytes), name, bytes.length);
    else throw new Failure("is neither an asset (.h5, .glb) nor a sky (.hdr, .exr).");
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

async function show(record, name, size) {
  const { faces, positions, K, quantity, missing, selftest } = record, fixed = quantity === "radiance", next = new Model(renderer, record);
  const off = await next.selftest(), met = off < 1e-3;
  model?.dispose();
  scene.clear().add((model = next).mesh);
  Object.assign(page, { model, renderer, selftest: off });
  const counts = `${(faces.length / 3).toLocaleString("en")} triangles · ${(positions.length / 3).toLocaleString("en")} vertices`;
  $("name").textContent = name;
  $("figures").textContent = `${counts} · ${(size / 1e6).toPrecision(3)} MB`;
  $("error").textContent = `Error: ${record.error}.`;
  const why = selftest.vertex.length ? "fails its self-test: another program changed the file, or this device computes wrongly" : "has no self-test";
  $("check").textContent = met ? "meets its self-test" : why;
  $("about").className = met ? "" : "bad";
  $("left-out").textContent = `Not shown: ${missing.join(", ")}. ${fixed ? "The light is that of the bake." : `Light is ${K} coefficients, so narrow light looks soft.`}`;
  for (const id of ["light-row", "turn-row", "drag"]) $(id).hidden = fixed;
  $("about").hidden = false;
  frameObject();
}

function frameObject() {
  const { geometry } = model.mesh, up = model.record.up === "z" ? [0, 0, 1] : [0, 1, 0];
  geometry.computeBoundingSphere();
  const { center, radius } = geometry.boundingSphere, tangent = Math.tan((camera.fov * Math.PI) / 360) * Math.min(1, camera.aspect);
  const [x, y, z] = objects[shown]?.from ?? [0.43, 0.24, 0.87], from = new THREE.Vector3(...(up[2] ? [x, -z, y] : [x, y, z])), away = (1.15 * radius) / Math.sin(Math.atan(tangent));
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
  const found = fixed ? [1, 1, 1] : await light.polar(Math.sqrt(record.K) - 1);
  if (light !== lights[number("light")] || record !== model.record) return;
  [polar, lightChanged] = [found, true];
  say("");
}

function frame() {
  if (!model) return;
  const began = performance.now();
  controls.update();
  if (lightChanged) model.setLight((page.light = turned(polar, model.record.up, number("turn"))));
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
  const openAll = (files) => (page.work = attempt(async () => {
    for (const file of files) say(`Loading ${file.name} …`), await open(new Uint8Array(await file.arrayBuffer()), file.name);
  }));
  const turnsLight = (event) => event.shiftKey || event.button === 2 || $("drag").ariaPressed === "true";
  new ResizeObserver(resize).observe(canvas);
  renderer.setAnimationLoop(frame);
  $("turn").oninput = () => (lightChanged = Boolean(polar));
  $("exposure").oninput = () => (viewChanged = true);
  $("light").onchange = $("height").oninput = () => attempt(relight);
  $("next").onclick = () => (page.work = attempt(() => showObject(shown + 1)));
  $("next-light").onclick = () => ($("light").value = (number("light") + 1) % lights.length, attempt(relight));
  $("drag").onclick = () => ($("drag").ariaPressed = $("drag").ariaPressed !== "true");
  $("file").onchange = () => openAll([...$("file").files]);
  document.ondragover = (event) => event.preventDefault();
  document.ondrop = (event) => (event.preventDefault(), openAll([...event.dataTransfer.files]));
  canvas.addEventListener("pointerdown", (event) => {
    if (controls) controls.enabled = !turnsLight(event);
    canvas.setPointerCapture(event.pointerId);
  }, true);
  canvas.onpointermove = (event) => {
    if (!controls || controls.enabled || !event.buttons) return;
    $("turn").value = ((number("turn") + 0.4 * event.movementX + 540) % 360) - 180;
    $("height").value = number("height") - 0.3 * event.movementY;
    attempt(relight);
  };
  canvas.onpointerup = canvas.onpointercancel = () => controls && (controls.enabled = true);
}

page.ready = attempt(start);
