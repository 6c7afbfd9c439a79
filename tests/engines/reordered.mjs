// Orders the vertices of a GLB otherwise, as tools do: node reordered.mjs IN.glb OUT.glb
import { Logger, NodeIO, VertexLayout } from "@gltf-transform/core";
import { ALL_EXTENSIONS } from "@gltf-transform/extensions";
import { reorder } from "@gltf-transform/functions";
import { MeshoptEncoder } from "meshoptimizer";

const io = new NodeIO().setLogger(new Logger(Logger.Verbosity.SILENT)).registerExtensions(ALL_EXTENSIONS);
const document = await io.read(process.argv[2]);
io.setVertexLayout(VertexLayout.SEPARATE); // 144 attributes in one row are more than glTF allows
const first = (read) => Array.from(read.getRoot().listMeshes()[0].listPrimitives()[0].getAttribute("TEXCOORD_1").getElement(0, []));
const before = first(document);
await document.transform(reorder({ encoder: MeshoptEncoder }));
await io.write(process.argv[3], document);
process.stdout.write(JSON.stringify({ before, after: first(await io.read(process.argv[3])) }));
