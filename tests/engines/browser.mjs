// Chromium without a window, and a static server, for tests of pages. Errors of the page fail the run.
// As a program: node browser.mjs [--webgpu] [--timeout=MILLISECONDS] FOLDER PAGE prints, as JSON, what the page's `window.result` resolves to.
// Chromium is $CHROMIUM or /usr/bin/chromium.
import { createServer } from "node:http";
import { mkdtemp, readFile, rm } from "node:fs/promises";
import { tmpdir } from "node:os";
import { extname, join, normalize, sep } from "node:path";
import { pathToFileURL } from "node:url";
import { parseArgs } from "node:util";
import puppeteer from "puppeteer-core";

const TYPES = {
  ".css": "text/css", ".hdr": "application/octet-stream", ".html": "text/html", ".js": "text/javascript",
  ".json": "application/json", ".mjs": "text/javascript", ".wasm": "application/wasm",
};
const FLAGS = [
  "--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist",
  "--disable-background-networking", "--disable-component-update", "--disable-sync", "--no-first-run",
];
const WEBGPU = ["--enable-unsafe-webgpu", "--use-webgpu-adapter=swiftshader", "--use-vulkan=swiftshader", "--enable-features=Vulkan"];

/** Serve folders on a free port of this machine: {"/": folder, "/vendor/": another}. Returns { url, missing, close }. */
export async function serve(folders, headers = {}) {
  const prefixes = Object.keys(folders).sort((a, b) => b.length - a.length); // the longest one that fits decides
  const missing = []; // paths that were asked for and are not there
  const server = createServer(async (request, response) => {
    const path = decodeURIComponent(new URL(request.url, "http://localhost").pathname);
    const prefix = prefixes.find((one) => path.startsWith(one));
    try {
      const inside = normalize(path.slice(prefix.length) || "index.html");
      if (inside === ".." || inside.startsWith(".." + sep)) throw new Error("outside of the folder");
      const bytes = await readFile(join(folders[prefix], inside.endsWith(sep) ? inside + "index.html" : inside));
      response.writeHead(200, { "Content-Type": TYPES[extname(inside)] ?? "application/octet-stream", ...headers });
      response.end(bytes);
    } catch {
      if (path !== "/favicon.ico") missing.push(path);
      response.writeHead(path === "/favicon.ico" ? 204 : 404).end();
    }
  });
  await new Promise((listening) => server.listen(0, "127.0.0.1", listening));
  return { url: `http://127.0.0.1:${server.address().port}/`, missing, close: () => server.close() };
}

/**
 * Give a new page to `use(page, browser)` and return what that returns.
 * Throws if the page logged an error, threw one, or asked for anything that is not on this machine.
 * Options: webgpu, width, height, flags (more of Chromium's), allowed (regular expressions of errors that are expected).
 */
export async function withPage(use, { webgpu = false, width = 512, height = 512, flags = [], allowed = [] } = {}) {
  const profile = await mkdtemp(join(tmpdir(), "prtbake-chromium-"));
  const browser = await puppeteer.launch({
    executablePath: process.env.CHROMIUM ?? "/usr/bin/chromium",
    headless: true,
    userDataDir: profile,
    args: [...FLAGS, ...(webgpu ? WEBGPU : []), ...flags],
    protocolTimeout: 300_000,
  });
  try {
    const errors = [];
    const note = (text) => allowed.some((pattern) => pattern.test(text)) || errors.push(text);
    const page = await browser.newPage();
    await page.setViewport({ width, height });
    page.on("console", (message) => message.type() === "error" && note(message.text()));
    page.on("pageerror", (error) => note(String(error.stack ?? error)));
    page.on("request", (request) => {
      const { hostname, protocol } = new URL(request.url());
      if (/^(http|ws)s?:$/.test(protocol) && hostname !== "127.0.0.1") note(`the page asked for ${request.url()}`);
    });
    page.on("requestfailed", (request) => note(`${request.url()}: ${request.failure()?.errorText}`));
    let found;
    try {
      found = await use(page, browser);
    } catch (error) { // what the page logged is usually the reason
      throw new Error([error.message, ...errors].join("\n"), { cause: error });
    }
    if (errors.length) throw new Error(errors.join("\n"));
    return found;
  } finally {
    await browser.close();
    await rm(profile, { recursive: true, force: true, maxRetries: 5 });
  }
}

/** Open the page of a folder, or of { "/": folder, … }, and return what its `window.result`, or a promise there, holds. */
export async function runPage(folders, page = "index.html", options = {}) {
  const server = await serve(typeof folders === "string" ? { "/": folders } : folders, options.headers);
  try {
    return await withPage(async (tab) => {
      await tab.goto(server.url + page);
      await tab.waitForFunction("window.result !== undefined", { timeout: options.timeout ?? 60_000 });
      return await tab.evaluate("window.result");
    }, options);
  } finally {
    server.close();
  }
}

if (import.meta.url === pathToFileURL(process.argv[1]).href) {
  const { values, positionals } = parseArgs({
    options: { webgpu: { type: "boolean" }, timeout: { type: "string", default: "60000" } },
    allowPositionals: true,
  });
  const found = await runPage(...positionals, { webgpu: values.webgpu, timeout: Number(values.timeout) });
  process.stdout.write(JSON.stringify(found) + "\n");
}
