// Drives the page of `prtbake export`: node page.mjs JOB.json FOUND.json, with a job { site, steps, webgpu, width, height, query, allowed }.
// FOUND.json gets what each step gives. A step is [name, ...arguments] of the functions below.
import { readFile, writeFile } from "node:fs/promises";
import { basename } from "node:path";
import { serve, withPage } from "./browser.mjs";

const job = JSON.parse(await readFile(process.argv[2], "utf8"));
const server = await serve({ "/": job.site }, job.headers);

/** What the page says, shows and measured. */
const state = (page) => page.evaluate(() => {
  const text = (id) => document.getElementById(id).textContent, value = (id) => Number(document.getElementById(id).value);
  const { backend, selftest, opened, frames, model, camera } = window.prtbake ?? {};
  const shown = (id) => !document.getElementById(id).hidden;
  return {
    backend, selftest, opened, frames, message: shown("message") ? text("message") : "", name: text("name"),
    figures: text("figures"), error: text("error"), check: text("check"), leftOut: text("left-out"), turn: value("turn"),
    height: value("height"), light: document.getElementById("light").selectedOptions[0]?.textContent, lights: shown("light-row"),
    eye: model?.eye.value.toArray(), heightShown: shown("height-row"), lit: model?.mesh.visible, angle: camera?.fov, aspect: camera?.aspect,
  };
});

const STEPS = {
  state,
  /** Wait until the page has done what it was asked to. */
  ready: (page) => page.evaluate(async () => void (await window.prtbake?.ready)),
  wait: (_, milliseconds) => new Promise((done) => setTimeout(done, milliseconds)),
  /** Radiance [V·3] of the vertices towards a point of object space under a light [K·3], read from the GPU. */
  radiance: (page, eye, light) => page.evaluate(async (eye, light) => {
    const { model } = window.prtbake;
    model.setLight(light);
    const found = await model.read(...eye.map((value, i) => value - model.record.origin[i]), 1);
    return Array.from(found, (value) => Math.max(0, value));
  }, eye, light),
  /** A picture of a camera { eye, target, up, fov, width, height }, under a light [K·3] or what is shown: linear RGBA, rows from the top. */
  picture: async (page, camera, light) => {
    const rows = await page.evaluate(async ({ eye, target, up, fov, width, height }, light) => {
      const THREE = await import("three"), { model, renderer, scene, backend } = window.prtbake;
      const place = (point) => new THREE.Vector3(...point).sub(new THREE.Vector3(...model.record.origin));
      const { radius } = model.mesh.geometry.boundingSphere;
      const view = new THREE.PerspectiveCamera(fov, width / height, radius / 100, 100 * radius);
      view.up.set(...up), view.position.copy(place(eye)), view.lookAt(place(target));
      const into = new THREE.RenderTarget(width, height, { type: THREE.FloatType });
      while (window.prtbake.busy()) await new Promise(requestAnimationFrame);
      if (light) model.setLight(light);
      (model.exposure.value = 1), model.eye.value.set(...view.position, 1);
      model.draw(into, () => renderer.render(scene, view));
      const pixels = await renderer.readRenderTargetPixelsAsync(into, 0, 0, width, height), rows = [];
      for (let y = 0; y < height; y++) rows.push(Array.from(pixels.subarray(4 * width * y, 4 * width * (y + 1))));
      return backend === "webgpu" ? rows : rows.reverse();
    }, camera, light);
    return rows;
  },
  /** Press an element, `times` times at once. */
  press: (page, selector, times) => page.$eval(selector, (one, times) => {
    for (let i = 0; i < times; i++) one.click();
  }, times),
  visible: (page, selector) => page.$eval(selector, (one) => one.checkVisibility()),
  work: (page) => page.evaluate(() => window.prtbake.work),
  /** The light [K·3] of object space that the page shows. */
  coefficients: (page) => page.evaluate(async () => {
    while (window.prtbake.busy()) await new Promise(requestAnimationFrame);
    return Array.from(window.prtbake.light);
  }),
  slide: (page, selector, value) => page.$eval(selector, (input, value) => {
    input.value = value;
    input.dispatchEvent(new Event("input"));
  }, value),
  click: async (page, selector) => {
    await page.click(selector);
    await page.evaluate(() => window.prtbake.work);
  },
  /** Wait until the view has come to rest. */
  rest: (page) => page.evaluate(async () => {
    const frame = () => new Promise(requestAnimationFrame), eye = () => String(window.prtbake.model?.eye.value.toArray());
    for (let still = 0, before = ""; still < 10; before = eye()) {
      await frame();
      still = eye() === before ? still + 1 : 0;
    }
  }),
  select: (page, selector, value) => page.select(selector, value),
  /** Drag from one point to another, with a button and keys. */
  drag: async (page, [x, y], [toX, toY], { button = "left", key } = {}) => {
    if (key) await page.keyboard.down(key);
    await page.mouse.move(x, y);
    await page.mouse.down({ button });
    await page.mouse.move(toX, toY, { steps: 5 });
    await page.mouse.up({ button });
    if (key) await page.keyboard.up(key);
  },
  /** Press Shift and a key `times` times while an element has the focus. */
  shift: async (page, selector, key, times) => {
    await page.focus(selector);
    await page.keyboard.down("Shift");
    for (let i = 0; i < times; i++) await page.keyboard.press(key);
    await page.keyboard.up("Shift");
  },
  /** Drag one finger. */
  swipe: async (page, [x, y], [toX, toY]) => {
    const touch = await page.touchscreen.touchStart(x, y);
    for (let i = 1; i <= 5; i++) await touch.move(x + ((toX - x) * i) / 5, y + ((toY - y) * i) / 5);
    await touch.end();
  },
  /** Move two fingers apart by half, up to two points. */
  pinch: async (page, [x, y], [toX, toY]) => {
    const [midX, midY] = [(x + toX) / 2, (y + toY) / 2], ends = [[x, y], [toX, toY]], fingers = [];
    const at = ([endX, endY], i) => [midX + ((endX - midX) * i) / 6, midY + ((endY - midY) * i) / 6];
    for (const end of ends) fingers.push(await page.touchscreen.touchStart(...at(end, 4)));
    for (let i = 5; i <= 6; i++) for (const [which, finger] of fingers.entries()) await finger.move(...at(ends[which], i));
    for (const finger of fingers) await finger.end();
  },
  /** Turn a phone, or change the size of the window. */
  resize: (page, width, height) => page.setViewport({ width, height, isMobile: Boolean(job.touch), hasTouch: Boolean(job.touch) }),
  /** Drop files on the page, and wait until it has opened them. */
  drop: async (page, ...paths) => {
    const files = await Promise.all(paths.map(async (path) => [basename(path), (await readFile(path)).toString("base64")]));
    await page.evaluate((files) => {
      const data = new DataTransfer();
      for (const [name, base64] of files) {
        data.items.add(new File([Uint8Array.from(atob(base64), (one) => one.charCodeAt(0))], name));
      }
      document.body.dispatchEvent(new DragEvent("drop", { bubbles: true, cancelable: true, dataTransfer: data }));
    }, files);
    await page.evaluate(() => window.prtbake.work);
  },
  lose: (page) => page.evaluate(() => void document.getElementById("view").getContext("webgl2").getExtension("WEBGL_lose_context").loseContext()),
  screenshot: (page, path) => page.screenshot({ path }),
};

const options = {
  flags: ["--use-vulkan=swiftshader"], // Chromium's WebGPU cannot show a canvas without it
  ...job, allowed: (job.allowed ?? []).map((one) => new RegExp(one)),
};
try {
  const found = await withPage(async (page) => {
    if (job.touch) await page.setViewport({ width: job.width, height: job.height, isMobile: true, hasTouch: true, deviceScaleFactor: 2 });
    if (job.before) await page.evaluateOnNewDocument(job.before);
    await page.goto(job.address ?? `${server.url}?${job.query ?? ""}`);
    const results = [];
    for (const [name, ...rest] of job.steps) results.push((await STEPS[name](page, ...rest)) ?? null);
    return results;
  }, options);
  await writeFile(process.argv[3], JSON.stringify(found));
  process.stdout.write("null");
} finally {
  server.close();
}
