// Assets in binary glTF (docs/reference/gltf.md), as data for shader.js. Other programs may have reordered the vertices.
import { Matrix3, Vector3 } from "three";
import { GLTFLoader } from "three/addons/loaders/GLTFLoader.js";
import { MeshoptDecoder } from "three/addons/libs/meshopt_decoder.module.js";
import { Failure } from "./sky.js";

const REFLECTED = "light reflected at the surface"; // which the page adds

/** Read an asset: its mesh, self-test and figures, and the data of the shader. */
export async function readGlb(bytes) {
  const gltf = await new GLTFLoader().setMeshoptDecoder(MeshoptDecoder).parseAsync(bytes.buffer, "").catch((cause) => {
    throw new Failure("is truncated or damaged; copy it again.", { cause });
  });
  const { json, associations } = gltf.parser, parts = [], factsOf = (part) => json.meshes[associations.get(part)?.meshes]?.extras?.prtbake;
  gltf.scene.updateMatrixWorld(true);
  gltf.scene.traverse((one) => one.isMesh && factsOf(one) && parts.push(one));
  if (!parts.length) throw new Failure("has no data of prtbake; if another program wrote it, export again.");
  const about = factsOf(parts[0]), { width, height } = about.texels, { light, vertex, outgoing, radiance } = about.selftest;
  if (!/^1\./.test(about.version)) throw new Failure(`has version ${about.version} of the layout, and this page reads 1.x; export a newer page.`);
  const R = (about.view_degree + 1) ** 2, K = about.quantity === "radiance" ? 1 : (about.light_degree + 1) ** 2, texels = Math.ceil((3 * K) / 4);
  const V = parts.reduce((sum, { geometry }) => sum + geometry.attributes.position.count, 0), data = new Float32Array(V * R * texels * 4);
  const [positions, normals] = [0, 1].map(() => new Float32Array(3 * V)), faces = [], numbers = [];
  const toLocal = new Matrix3().setFromMatrix4(parts[0].matrixWorld).invert();
  const toObject = new Matrix3().set(...about.local_to_object).multiply(toLocal); // up to a scale, which is that of all parts
  const origin = new Vector3().setFromMatrixPosition(parts[0].matrixWorld).applyMatrix3(toObject);
  const texelSet = `uv${(about.texel_attribute ?? "TEXCOORD_1").slice("TEXCOORD_".length)}`;
  for (const { geometry, matrixWorld } of parts) {
    if (!geometry.attributes.normal) geometry.computeVertexNormals();
    const order = matrixWorld.determinant() * toObject.determinant() < 0 ? [0, 1, -1] : [0, 0, 0];
    const before = numbers.length, { position, normal, [texelSet]: texel } = geometry.attributes, corners = geometry.index;
    const ofNormals = new Matrix3().setFromMatrix4(matrixWorld).premultiply(toObject).invert().transpose();
    for (let i = 0; i < (corners ?? position).count; i++) {
      const corner = i + order[i % 3]; // a mirrored part has its faces turned
      faces.push(before + (corners ? corners.getX(corner) : corner));
    }
    for (let v = 0; v < position.count; v++) {
      const at = 3 * (before + v);
      new Vector3().fromBufferAttribute(position, v).applyMatrix4(matrixWorld).applyMatrix3(toObject).sub(origin).toArray(positions, at);
      new Vector3().fromBufferAttribute(normal, v).applyNormalMatrix(ofNormals).toArray(normals, at);
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
  const percent = (value) => `${(100 * value).toPrecision(2)} %`, { coefficients, radiance_median } = about.error;
  return {
    positions, normals, eta: about.eta, roughness: about.roughness ?? 0, faces: Uint32Array.from(faces), origin: origin.toArray(), up: about.up,
    error: `${about.asset_error}; this form adds ${percent(coefficients)} of the coefficients, ${percent(radiance_median)} of radiance`,
    missing: about.left_out.filter((one) => one !== REFLECTED), quantity: about.quantity, form: "harmonics", data, texels, K, C: 3, R,
    selftest: { light: light.flat(), vertex: vertex.map((v) => numbers.indexOf(v)), outgoing: outgoing.flat(), radiance: radiance.flat() },
  };
}
