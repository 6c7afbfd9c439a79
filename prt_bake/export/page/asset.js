// Assets in HDF5, plain (docs/reference/asset.md) and compact (compact_asset.md), as data for shader.js.
import { DataUtils } from "three";
import { Failure } from "./sky.js";

const BLOCK = 1 << 22, { fromHalfFloat, toHalfFloat } = DataUtils; // numbers that HDF5 decodes at a time
const rows = (Kind, length) => new Kind(32768 * Math.ceil(length / 32768)); // whole rows of a texture: large data is not copied

/** Read an asset: its mesh, self-test and figures, and the data of the shader. */
export async function readAsset(bytes) {
  const h5 = await import("h5wasm"), module = await h5.ready;
  module.FS.writeFile("/asset.h5", bytes, { canOwn: true });
  let file;
  try {
    return readRecord(readerOf(module, (file = new h5.File("/asset.h5", "r"))));
  } catch (error) {
    throw error instanceof Failure ? error : new Failure("is truncated or damaged; copy it again.", { cause: error });
  } finally {
    file?.close();
    module.FS.unlink("/asset.h5");
  }
}

function readerOf(module, file) {
  const shape = (path) => file.get(path)?.shape?.map(Number);
  const attribute = (path, name) => {
    const value = file.get(path)?.attrs[name]?.value;
    return typeof value === "bigint" ? Number(value) : value;
  };
  /** Numbers as they are stored, half floats as Uint16Array, of all rows or of `count` rows from `first`. */
  const read = (path, first = 0, count = shape(path)[0]) => {
    const { type, size, signed } = file.get(path).metadata, rest = shape(path).slice(1), length = rest.reduce((a, b) => a * b, count);
    const Kind = type === 1 ? { 2: Uint16Array, 4: Float32Array, 8: Float64Array }[size]
      : (signed ? { 1: Int8Array, 2: Int16Array, 4: Int32Array } : { 1: Uint8Array, 2: Uint16Array, 4: Uint32Array })[size];
    const part = [[count, ...rest], [first, ...rest.map(() => 0)], [1, ...rest.map(() => 1)]].map((one) => one.map(BigInt));
    const at = module._malloc(length * size);
    module.get_dataset_data(file.file_id, path, ...part, BigInt(at)); // `.value` refuses half floats
    const numbers = new Kind(module.HEAPU8.slice(at, at + length * size).buffer);
    module._free(at);
    return numbers;
  };
  return { shape, attribute, read, half: (path) => file.get(path).metadata.size === 2, text: (path) => file.get(path)?.value };
}

function readRecord(reader) {
  const { read, shape, attribute } = reader, version = attribute("/", "format_version");
  if (attribute("/", "format") !== "prtbake") throw new Failure("is an HDF5 file, but no asset of prtbake.");
  if (!/^1\./.test(version)) throw new Failure(`has version ${version} of the format, and this page reads 1.x; export a newer page.`);
  const group = shape("/transfer_compact/digits_0") ? "/transfer_compact" : "/transfer", sectors = attribute("/bins", "sectors");
  const [positions, normals, tangents, faces] = ["positions", "normals", "tangents", "faces"].map((name) => read(`/mesh/${name}`));
  const tested = (name) => (shape("/selftest/light") ? read(`/selftest/${name}`) : []);
  const [light, vertex, outgoing, radiance] = ["light", "vertex", "outgoing", "radiance"].map(tested);
  const { eta = 1, roughness, model, walks, estimated_relative_rmse: bake } = JSON.parse(reader.text("/provenance/json") ?? "{}");
  const missing = [...JSON.parse(attribute("/", "left_out") ?? "[]").map(({ item }) => item)];
  if (shape("/lobes/axes")) missing.push("lobes");
  if (!attribute("/", "complete")) missing.push("vertices not baked yet, which are black");
  const network = walks === undefined ? [["network", attribute("/", "network_error")?.[0]]] : []; // as in record.py
  const error = [...network, ["bake", Math.hypot(bake?.total ?? NaN, attribute(group, "error") ?? 0)]]; // Math.hypot takes null as 0
  return {
    positions, normals, tangents, faces, origin: attribute("/mesh/positions", "origin"), up: attribute("/", "up"),
    valid: shape(`${group}/valid`) && read(`${group}/valid`), quantity: attribute(group, "quantity"),
    error: error.map(([name, value]) => `${name} ${value > 0 ? `${(100 * value).toPrecision(2)} %` : "unknown"}`).join(", "),
    missing, eta, roughness: roughness ?? model?.roughness ?? 0,
    selftest: { light, vertex, outgoing, radiance }, rings: attribute("/bins", "rings"), sectors,
    ...(group === "/transfer" ? plainData : compactData)(reader, sectors),
  };
}

/** For each vertex and bin the K·C coefficients in texels of four, and last the mean of the first ring. */
function plainData({ shape, read, half }, sectors) {
  const path = "/transfer/coefficients", [V, B, K, C] = shape(path), n = K * C, texels = Math.ceil(n / 4), isHalf = half(path);
  const row = (B > 1 ? B + 1 : 1) * texels * 4, data = rows(isHalf ? Uint16Array : Float32Array, V * row), mean = new Float64Array(n);
  const widened = Float32Array.from({ length: 65536 }, (_, code) => fromHalfFloat(code)), step = Math.ceil(BLOCK / B / n);
  for (let first = 0; first < V; first += step) {
    const count = Math.min(step, V - first), block = read(path, first, count);
    for (let v = 0, from = 0; v < count; v++) {
      let to = (first + v) * row;
      mean.fill(0);
      for (let b = 0; b < B; b++, to += 4 * texels) {
        if (b < sectors) for (let i = 0; i < n; i++) mean[i] += (isHalf ? widened[block[from + i]] : block[from + i]) / sectors;
        for (let i = 0; i < n; i++) data[to + i] = block[from++];
      }
      if (B > 1) mean.forEach((value, i) => (data[to + i] = isHalf ? toHalfFloat(value) : value));
    }
  }
  return { form: "bins", data, texels, K, C, B };
}

/** Codes in texels of four with one view function, and the view functions [B + 1, R], the last row for the pole. */
function compactData({ shape: shapeOf, read, attribute }, sectors) {
  const path = (name) => `/transfer_compact/${name}`, shape = (name) => shapeOf(path(name)), from = (name) => read(path(name));
  const digitsOf = (name) => [0, 1, 2, 3].map((d) => `${name}_${d}`).filter(shape);
  const [P, V] = shape("digits_0"), [, K, C] = shape("channel_basis"), view = from("view_component"), channel = from("channel_component");
  const { R, B, value } = viewFunctions(from, shape, digitsOf), first = new Uint32Array(R + 1), slot = new Uint32Array(P);
  view.forEach((r) => first[r + 1]++);
  for (let r = 0; r < R; r++) first[r + 1] = first[r] + Math.ceil(first[r + 1] / 4);
  const next = first.map((texel) => 4 * texel), row = 4 * first[R], channels = new Int32Array(row).fill(-1), digits = digitsOf("digits");
  view.forEach((r, p) => (channels[(slot[p] = next[r]++)] = channel[p]));
  const wide = digits.length > 2, data = rows(wide ? Float32Array : Uint16Array, V * row), step = Math.ceil(BLOCK / V);
  for (let p = 0; p < P; p += step) {
    const count = Math.min(step, P - p), parts = digits.map((name) => read(path(name), p, count));
    for (let at = 0; at < count * V; at++) {
      let code = 0;
      for (let d = parts.length; d--; ) code = 256 * code + parts[d][at];
      if (code) data[(at % V) * row + slot[p + Math.floor(at / V)]] = wide ? code : toHalfFloat(code);
    }
  }
  const width = 4 * Math.ceil(R / 4), table = new Float32Array((B + 1) * width);
  for (let i = 0; i < R * B; i++) table[(i % B) * width + Math.floor(i / B)] = value(Math.floor(i / B), i % B);
  for (let b = 0; b < Math.min(sectors, B); b++) for (let r = 0; r < R; r++) table[B * width + r] += value(r, b) / sectors;
  return { form: "codes", data, K, C, B, R, table, first, channels, basis: from("channel_basis"), scale: attribute("/transfer_compact", "step") };
}

function viewFunctions(from, shape, digitsOf) {
  if (shape("view_scale")) {
    const scale = from("view_scale"), parts = digitsOf("view_digits").map(from), [R, B] = shape("view_digits_0");
    return { R, B, value: (r, b) => scale[r] * parts.reduceRight((sum, part) => 256 * sum + part[r * B + b], 0) };
  }
  const [[I, rings], [M, sectors]] = [shape("ring_basis"), shape("sector_basis")], ring = from("ring_basis"), sector = from("sector_basis");
  const value = (r, b) => ring[Math.floor(r / M) * rings + Math.floor(b / sectors)] * sector[(r % M) * sectors + (b % sectors)];
  return { R: I * M, B: rings * sectors, value };
}
