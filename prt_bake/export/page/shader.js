// Radiance of vertices on the GPU: over view functions, their weight times coefficients times light.
import * as THREE from "three";
import * as TSL from "three/tsl";
import { harmonics } from "./light.js";
import { Reflection } from "./reflection.js";
import { Failure } from "./sky.js";

const { Fn, If, Loop, attribute, dot, float, int, ivec2, textureLoad, uniform, uniformArray, varying, vec2, vec3, vec4 } = TSL;
const READ = 256; // width of what is read back: rows of WebGPU are multiples of 256 bytes
const RGB = [0, 1, 2];

/** The mesh of an asset. `eye` is relative to its origin: a point (w = 1) or a direction (w = 0). */
export class Model {
  constructor(renderer, record) {
    const { gl } = renderer.backend, side = Math.min(8192, gl?.getParameter(gl.MAX_TEXTURE_SIZE) ?? 8192);
    const { positions, normals, tangents, faces, valid, form, texels } = record, count = positions.length / 3;
    Object.assign(this, { renderer, record, side, count, disposable: [], eye: uniform(new THREE.Vector4()), exposure: uniform(1) });
    const geometry = this.keep(new THREE.BufferGeometry()), attributes = { position: positions, normal: normals, axis: tangents };
    attributes.valid = Float32Array.from({ length: count }, (_, v) => (valid ? valid[v] : 1));
    for (const name in attributes) {
      if (attributes[name]) geometry.setAttribute(name, new THREE.BufferAttribute(attributes[name], attributes[name].length / count));
    }
    this.data = this.texture(record.data);
    if (form === "codes") this.prepareFold();
    else this.weights = uniformArray(Array.from({ length: 3 * texels }, () => new THREE.Vector4()), "vec4");
    const radiance = this.radiance(), baked = attribute("valid", "float");
    const shown = varying(vec4(radiance.max(0).mul(baked), baked)); // vertices that were not baked leave no dark seam
    const material = this.keep(new THREE.MeshBasicNodeMaterial());
    this.inner = shown.xyz.div(shown.w.max(1e-6));
    this.reflection = new Reflection(record);
    this.mesh = new THREE.Mesh(geometry.clone().setIndex(new THREE.BufferAttribute(faces, 1)), material);
    this.keep(this.mesh.geometry);
    this.reflect(null);
    this.prepareReading(geometry, varying(radiance));
  }

  /** Add the light reflected at the surface, of a light or, for null, of none. */
  reflect(light) {
    if (light === this.reflected) return;
    this.reflected = light;
    const toEye = () => this.eye.xyz.sub(TSL.positionLocal.mul(this.eye.w)), { material } = this.mesh;
    const added = light && this.reflection.node(toEye(), varying(attribute("normal", "vec3")), light.texture);
    material.colorNode = (added ? this.inner.add(added) : this.inner).mul(this.exposure);
    material.needsUpdate = true;
  }

  keep(one) {
    return this.disposable.push(one), one;
  }

  dispose() {
    this.disposable.forEach((one) => one.dispose());
  }

  /** Texels of four numbers, half floats or floats, in rows of `side`. */
  texture(numbers) {
    const height = Math.ceil(numbers.length / 4 / this.side), fits = numbers.length === 4 * this.side * height;
    if (height > this.side) throw new Failure("is too large for this device; compress it, or bake fewer view bins.");
    const padded = fits ? numbers : new numbers.constructor(4 * this.side * height);
    if (!fits) padded.set(numbers);
    const type = numbers instanceof Uint16Array ? THREE.HalfFloatType : THREE.FloatType;
    return Object.assign(this.keep(new THREE.DataTexture(padded, this.side, height, THREE.RGBAFormat, type)), { needsUpdate: true });
  }

  at(texture, texel) {
    return textureLoad(texture, ivec2(texel.mod(int(this.side)), texel.div(int(this.side))));
  }

  /** RGB of the coefficients that begin at a texel, under the light. */
  lit(texel) {
    return Array.from({ length: this.record.texels }, (_, i) => {
      const four = this.at(this.data, texel.add(i)).toVar();
      return vec3(...RGB.map((c) => dot(four, this.weights.element(3 * i + c))));
    }).reduce((sum, one) => sum.add(one));
  }

  /** The node of the radiance of a vertex, not clamped. */
  radiance() {
    const { form, B, R, texels } = this.record, wide = Math.ceil(R / 4);
    return Fn(() => {
      const sum = vec3(0).toVar(), vertex = int(TSL.vertexIndex);
      const toEye = this.eye.xyz.sub(TSL.positionGeometry.mul(this.eye.w)).normalize().toVar();
      if (form === "harmonics") {
        const values = harmonics(Math.sqrt(R) - 1, [toEye.x, toEye.y, toEye.z], TSL);
        values.forEach((value, r) => sum.addAssign(this.lit(vertex.mul(R).add(r).mul(texels)).mul(value)));
      } else if (form === "bins") {
        const first = vertex.mul(B > 1 ? B + 1 : 1).toVar();
        this.bins(toEye, (bin, weight) => sum.addAssign(this.lit(first.add(bin).mul(texels)).mul(weight)));
      } else {
        Loop({ start: int(0), end: int(wide), type: "int" }, ({ i }) => {
          const weights = vec4(0).toVar(), first = vertex.mul(wide).add(i).mul(4).toVar();
          this.bins(toEye, (bin, weight) => weights.addAssign(this.at(this.table, bin.mul(wide).add(i)).mul(weight)));
          ["x", "y", "z", "w"].forEach((r, n) => sum.addAssign(this.at(this.folded.texture, first.add(n)).xyz.mul(weights[r])));
        });
      }
      return sum;
    })();
  }

  /** Call `use(bin, weight)` for the view bins of a direction; bin B is the mean of the first ring. */
  bins(toEye, use) {
    const { rings, sectors, B } = this.record, n = attribute("normal", "vec3"), t = attribute("axis", "vec3");
    if (B === 1) return use(int(0), float(1));
    const x = dot(toEye, t), y = dot(toEye, n.cross(t)), depth = float(1).sub(dot(toEye, n)).mul(rings).sub(0.5).toVar();
    const ring = depth.clamp(0, rings - 1).toVar(), low = int(ring).toVar(), pole = depth.mul(-2).clamp(0, 1).toVar();
    const turn = TSL.atan(y, x.add(1e-20)).mul(sectors / (2 * Math.PI)).add(sectors - 0.5).toVar(), h = turn.fract().toVar();
    const left = int(turn).mod(int(sectors)).toVar(), right = left.add(1).mod(int(sectors)).toVar();
    for (const [row, a] of [[low, ring.fract().oneMinus()], [low.add(1).min(rings - 1), ring.fract()]]) {
      const share = a.mul(pole.oneMinus()).toVar();
      use(row.mul(sectors).add(left), share.mul(h.oneMinus())), use(row.mul(sectors).add(right), share.mul(h));
    }
    If(pole.greaterThan(0), () => void use(int(B), pole));
  }

  /** A pass that folds a light into the codes, RGB for each vertex and view function. It runs when the light changes. */
  prepareFold() {
    const { R, first, channels, table } = this.record, { side } = this, wide = 4 * Math.ceil(R / 4), row = channels.length / 4;
    const start = this.texture(Float32Array.from({ length: 4 * (wide + 1) }, (_, i) => first[Math.min(R, i >> 2)]));
    this.light = this.texture(new Float32Array(3 * channels.length));
    this.table = this.texture(table);
    this.folded = this.keep(new THREE.RenderTarget(side, Math.ceil((this.count * wide) / side), { type: THREE.FloatType, depthBuffer: false }));
    const material = this.keep(new THREE.NodeMaterial());
    material.fragmentNode = Fn(() => {
      const pixel = int(TSL.screenCoordinate.y).mul(side).add(int(TSL.screenCoordinate.x)), sum = vec3(0).toVar();
      const r = pixel.mod(int(wide)).toVar(), codes = pixel.div(int(wide)).mul(row).toVar();
      Loop({ start: int(this.at(start, r).x), end: int(this.at(start, r.add(1)).x), type: "int" }, ({ i }) => {
        const four = this.at(this.data, codes.add(i)).toVar();
        sum.addAssign(vec3(...RGB.map((c) => dot(four, this.at(this.light, i.mul(3).add(c))))));
      });
      return vec4(sum, 1);
    })();
    this.fold = new THREE.QuadMesh(material);
  }

  /** Set the light [K·3] of object space. */
  setLight(b) {
    const { form, quantity, K, C, channels, basis, scale } = this.record, at = (k, c) => (quantity === "radiance" ? 1 : b[3 * k + c]);
    if (form !== "codes") {
      const weight = (i, c) => (i < K * C && (C === 1 || i % 3 === c) ? at(Math.floor(i / C), c) : 0);
      this.weights.array.forEach((four, i) => four.set(...[0, 1, 2, 3].map((n) => weight(4 * Math.floor(i / 3) + n, i % 3))));
      return;
    }
    const lit = Array.from({ length: (3 * basis.length) / (K * C) }, (_, i) => {
      const j = Math.floor(i / 3), c = i % 3;
      return scale * Array.from({ length: K }, (_, k) => basis[(j * K + k) * C + (c % C)] * at(k, c)).reduce((sum, one) => sum + one);
    });
    channels.forEach((j, i) => RGB.forEach((c) => (this.light.image.data[12 * (i >> 2) + 4 * c + (i & 3)] = j < 0 ? 0 : lit[3 * j + c])));
    this.light.needsUpdate = true;
    this.draw(this.folded, () => this.fold.render(this.renderer));
  }

  draw(target, render) {
    this.renderer.setRenderTarget(target);
    render();
    this.renderer.setRenderTarget(null);
  }

  /** Points, one a vertex, that write radiance into a target that is read back. */
  prepareReading(geometry, radiance) {
    const size = vec2(READ, Math.ceil(this.count / READ)), up = this.renderer.backend.isWebGPUBackend ? -1 : 1, v = int(TSL.vertexIndex);
    this.target = this.keep(new THREE.RenderTarget(READ, Math.ceil(this.count / READ), { type: THREE.FloatType, depthBuffer: false }));
    const material = this.keep(new THREE.NodeMaterial()), place = vec2(v.mod(int(READ)), v.div(int(READ))).add(0.5).div(size);
    material.vertexNode = vec4(place.mul(2).sub(1).mul(vec2(1, up)), 0, 1);
    material.fragmentNode = vec4(radiance, 1);
    this.points = Object.assign(new THREE.Points(geometry, material), { frustumCulled: false });
  }

  /** Radiance [V·3] of the vertices, not clamped, towards a point (w = 1) or in a direction (w = 0). */
  async read(...eye) {
    const before = this.eye.value.toArray();
    this.eye.value.set(...eye);
    this.draw(this.target, () => this.renderer.render(this.points, new THREE.OrthographicCamera()));
    this.eye.value.set(...before);
    const pixels = await this.renderer.readRenderTargetPixelsAsync(this.target, 0, 0, READ, this.target.height);
    return Float32Array.from({ length: 3 * this.count }, (_, i) => pixels[4 * Math.floor(i / 3) + (i % 3)]);
  }

  /** The largest difference from the self-test, relative to its largest radiance; NaN if there is none, or its vertices are gone. */
  async selftest() {
    const { light, vertex, outgoing, radiance } = this.record.selftest, differences = [];
    if (vertex.length) this.setLight(light);
    const found = await Promise.all(Array.from(vertex, (_, s) => this.read(...outgoing.slice(3 * s, 3 * s + 3), 0)));
    radiance.forEach((value, i) => differences.push(Math.abs(found[Math.floor(i / 3)][3 * vertex[Math.floor(i / 3)] + (i % 3)] - value)));
    return differences.length ? Math.max(...differences) / Math.max(...radiance.map(Math.abs)) : NaN;
  }
}
