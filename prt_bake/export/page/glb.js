// Assets in binary glTF (docs/reference/gltf.md), as data for shader.js. Other programs may have reordered the vertices.
import { Matrix3, Vector3 } from "three";
import { GLTFLoader } from "three/addons/loaders/GLTFLoader.js";
import { MeshoptDecoder } from "three/addons/libs/meshopt_decoder.module.js";
import { Failure } from "./sky.js";

/** Read an asset: its mesh, self-test and figures, and the data of the shader. */
export async function readGlb(bytes) {
  const gltf = await new GLTFLoader().setMeshoptDecoder(MeshoptDecoder).parseAsync(bytes.buffer, "").catch((cause) => {
    throw new Failure("is truncated or damaged; copy it again.", { cause });
  });
  const { json, associations } = gltf.parser, index = (json.meshes ?? []).findIndex((mesh) => mesh.extras?.prtbake), parts = [];
  if (index < 0) throw new Failure("has no data of prtbake; if another program wrote it, export again.");
  const about = json.meshes[index].extras.prtbake, { width, height } = about.texels, { light, vertex, outgoing, radiance } = about.selftest;
  if (!/^1\./.test(about.version)) throw new Failure(`has version ${about.version} of the layout, and this page reads 1.x; export a newer page.`);
  gltf.scene.traverse((one) => one.isMesh && associations.get(one)?.meshes === index && parts.push(one));
  const R = (about.view_degree + 1) ** 2, K = about.quantity === "radiance" ? 1 : (about.light_degree + 1) ** 2, texels = Math.ceil((3 * K) / 4);
  const V = parts.reduce((sum, { geometry }) => sum + geometry.attributes.position.count, 0), data = new Float32Array(V * R * texels * 4);
  const toObject = new Matrix3().set(...about.local_to_object), positions = new Float32Array(3 * V), faces = [], numbers = [];
  const texelSet = `uv${(about.texel_attribute ?? "TEXCOORD_1").slice("TEXCOORD_".length)}`;
  for (const { geometry } of parts) {
    const before = numbers.length, { position, [texelSet]: texel } = geometry.attributes, corners = geometry.index;
    for (let i = 0; i < (corners ?? position).count; i++) faces.push(before + (corners ? corners.getX(i) : i));
    for (let v = 0; v < position.count; v++) {
      new Vector3().fromBufferAttribute(position, v).applyMatrix3(toObject).toArray(positions, 3 * (before + v));
      numbers.push(texel ? Math.floor(texel.getX(v) * width) + width * Math.floor(texel.getY(v) * height) : v);
    }
    for (let i = 0; i < R * K; i++) {
      const [r, k] = [Math.floor(i / K), i % K], name = about.attributes.replace("{r}", r).replace("{k}", k);
      const values = geometry.attributes[name.toLowerCase()], scale = about.scales?.[r][k] ?? [1, 1, 1];
      if (!values) throw new Failure(`has lost ${name} in another program; export it again.`);
      for (let v = 0; v < position.count; v++) {
        for (let c = 0; c < 3; c++) data[((before + v) * R + r) * 4 * texels + 3 * k + c] = values.getComponent(v, c) * scale[c];
      }
    }
  }
  gltf.scene.updateMatrixWorld(true);
  const toLocal = new Matrix3().setFromMatrix4(parts[0].matrixWorld).invert(), place = new Vector3().setFromMatrixPosition(parts[0].matrixWorld);
  const percent = (value) => `${(100 * value).toPrecision(2)} %`, { coefficients, radiance_median } = about.error;
  return {
    positions, faces: Uint32Array.from(faces), origin: place.applyMatrix3(toLocal).applyMatrix3(toObject).toArray(), up: about.up,
    error: `${about.asset_error}; this form adds ${percent(coefficients)} of the coefficients, ${percent(radiance_median)} of radiance`,
    missing: about.left_out, quantity: about.quantity, form: "harmonics", data, texels, K, C: 3, R,
    selftest: { light: light.flat(), vertex: vertex.map((v) => numbers.indexOf(v)), outgoing: outgoing.flat(), radiance: radiance.flat() },
  };
}
