// What other people's programs make of glTF files, as JSON:
//   node gltf.mjs validate FILE…             errors and warnings that the Khronos validator finds
//   node gltf.mjs three FILE                 names and numbers of the attributes that three.js's loader finds
//   node gltf.mjs transform IN FOLDER NAME…  files after a function of glTF-Transform, NAME.glb, and the same without
//                                            compression, NAME.plain.glb; their sizes in bytes
import { readFile, stat } from "node:fs/promises";
import { join } from "node:path";
import { Logger, NodeIO, VertexLayout } from "@gltf-transform/core";
import { ALL_EXTENSIONS, EXTMeshoptCompression } from "@gltf-transform/extensions";
import * as functions from "@gltf-transform/functions";
import { MeshoptDecoder, MeshoptEncoder, MeshoptSimplifier } from "meshoptimizer";
import validator from "gltf-validator";

async function validate(...paths) {
  const found = {};
  for (const path of paths) {
    const report = await validator.validateBytes(new Uint8Array(await readFile(path)), { maxIssues: 50 });
    const { numErrors, numWarnings, messages } = report.issues;
    found[path] = { errors: numErrors, warnings: numWarnings, messages: messages.filter((one) => one.severity < 2) };
  }
  return found;
}

async function three(path) {
  globalThis.self = globalThis; // the loader expects a browser
  const { GLTFLoader } = await import("three/addons/loaders/GLTFLoader.js");
  const loader = new GLTFLoader().setMeshoptDecoder(MeshoptDecoder);
  const { buffer } = new Uint8Array(await readFile(path));
  const { scene } = await loader.parseAsync(buffer, "");
  scene.updateMatrixWorld(true);
  const meshes = [];
  scene.traverse((node) => {
    if (!node.isMesh) return;
    const attributes = {};
    for (const [name, { array, itemSize, normalized }] of Object.entries(node.geometry.attributes)) {
      const kind = array.constructor.name;
      const bytes = Buffer.from(array.buffer, array.byteOffset, array.byteLength).toString("base64");
      attributes[name] = { kind, itemSize, normalized, bytes };
    }
    const extras = node.userData.prtbake ?? node.parent?.userData.prtbake ?? node.geometry.userData.prtbake;
    meshes.push({ name: node.name, attributes, extras, matrix: node.matrixWorld.elements });
  });
  return meshes;
}

const FUNCTIONS = {
  ...functions,
  "read, write": () => () => {},
  "read, write interleaved": () => () => {},
  meshopt: () => functions.meshopt({ encoder: MeshoptEncoder }),
  reorder: () => functions.reorder({ encoder: MeshoptEncoder }),
  simplify: () => functions.simplify({ simplifier: MeshoptSimplifier, ratio: 0.5, error: 0.01 }),
  "prune({ keepAttributes: true })": () => functions.prune({ keepAttributes: true }),
  // The command of the page: what `optimize` of the command line does with its options.
  optimize: () => (document) =>
    document.transform(
      ...["dedup", "instance", "palette", "flatten", "join", "weld", "resample"].map((name) => functions[name]()),
      functions.prune({ keepAttributes: true, keepIndices: false, keepLeaves: false }),
      functions.sparse(),
      functions.meshopt({ encoder: MeshoptEncoder }),
    ),
  // The compression alone: no number is rounded, no vertex moves.
  EXT_meshopt_compression: () => (document) => {
    document.createExtension(EXTMeshoptCompression).setRequired(true).setEncoderOptions({ method: "quantize" });
  },
};

async function transform(from, folder, ...names) {
  await Promise.all([MeshoptDecoder.ready, MeshoptEncoder.ready, MeshoptSimplifier.ready]);
  const io = new NodeIO().registerExtensions(ALL_EXTENSIONS);
  io.registerDependencies({ "meshopt.decoder": MeshoptDecoder, "meshopt.encoder": MeshoptEncoder });
  const layout = { interleaved: VertexLayout.INTERLEAVED, separate: VertexLayout.SEPARATE };
  const sizes = {};
  for (const name of names) {
    const path = join(folder, `${name}.glb`);
    const document = (await io.read(from)).setLogger(new Logger(Logger.Verbosity.ERROR));
    await document.transform(FUNCTIONS[name]());
    io.setVertexLayout(layout[name.endsWith("interleaved") ? "interleaved" : "separate"]);
    await io.write(path, document);
    sizes[name] = (await stat(path)).size;
    const plain = await io.read(path);
    plain.getRoot().listExtensionsUsed().find((one) => one instanceof EXTMeshoptCompression)?.dispose();
    await io.write(join(folder, `${name}.plain.glb`), plain);
  }
  return sizes;
}

const [command, ...rest] = process.argv.slice(2);
const found = await { validate, three, transform }[command](...rest);
process.stdout.write(JSON.stringify(found) + "\n");
