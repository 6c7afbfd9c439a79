// Light reflected at the surface (docs/explanation/reflection.md): a sky, or a sun without size.
// A sky is filtered for the roughness by three.js, and multiplied by the albedo of the surface (Karis, "Real Shading in Unreal Engine 4", 2013),
// in the mean direction of the lobe (Lagarde and de Rousiers, "Moving Frostbite to PBR", 2014).
import * as THREE from "three";
import * as TSL from "three/tsl";

const SMOOTH = 0.02, SHARPEST_SUN = 0.05, { float, reflect, uniform, vec3 } = TSL;

/** What the surface of an asset adds to its radiance. */
export class Reflection {
  constructor({ eta, roughness, up }) {
    Object.assign(this, { eta, roughness, up, toSky: uniform(new THREE.Matrix3()), toSun: uniform(new THREE.Vector3()) });
  }

  /** Turn the light about up; the frame of skies is y up, its azimuth from x to z. */
  turn(degrees) {
    const c = Math.cos((degrees * Math.PI) / 180), s = Math.sin((degrees * Math.PI) / 180);
    this.toSky.value.set(...(this.up === "y" ? [c, 0, -s, 0, 1, 0, s, 0, c] : [c, s, 0, 0, 0, 1, s, -c, 0]));
  }

  /** Fresnel's reflectance of unpolarised light from outside. */
  fresnel(cosine) {
    const { eta } = this, inside = cosine.pow2().oneMinus().div(eta ** 2).oneMinus().max(0).sqrt().toVar();
    const square = (a, b) => a.sub(b).div(a.add(b)).pow2();
    return square(cosine.mul(eta), inside).add(square(cosine, inside.mul(eta))).mul(0.5);
  }

  /** The share of light that the surface reflects; that of three.js has Schlick's reflectance. */
  albedo(cosine) {
    if (this.roughness < SMOOTH) return this.fresnel(cosine);
    const upright = ((this.eta - 1) / (this.eta + 1)) ** 2, schlick = cosine.oneMinus().pow(5).mul(1 - upright).add(upright);
    const parts = TSL.DFGLUT({ roughness: float(Math.sqrt(this.roughness)), dotNV: cosine });
    return parts.x.mul(upright).add(parts.y).mul(this.fresnel(cosine)).div(schlick);
  }

  /** The node of the light reflected to an observer, of a sky's texture or, without one, of the sun of irradiance π. */
  node(toEye, normal, sky) {
    const [n, v] = [normal, toEye].map((one) => this.toSky.mul(one.normalize()).toVar()), facing = n.dot(v).clamp(1e-4, 1).toVar();
    if (sky) {
      const rough = this.roughness, share = (1 - rough) * (Math.sqrt(1 - rough) + rough); // the lobe of a rough surface leans to the normal
      return TSL.pmremTexture(sky, TSL.mix(n, reflect(v.negate(), n), share), Math.sqrt(rough)).mul(this.albedo(facing));
    }
    const alpha = Math.max(this.roughness, SHARPEST_SUN), half = v.add(this.toSun).normalize().toVar(), level = n.dot(this.toSun).max(0).toVar();
    const seen = (cosine) => float(2).div(cosine.add(cosine.pow2().mul(1 - alpha ** 2).add(alpha ** 2).sqrt())); // masking, divided by the cosine
    const facets = float(alpha ** 2 / Math.PI).div(n.dot(half).pow2().mul(alpha ** 2 - 1).add(1).pow2());
    return vec3(facets.mul(seen(facing)).mul(seen(level)).mul(level).mul(Math.PI / 4).mul(this.fresnel(half.dot(v))));
  }
}

/** The texture of a sky, as three.js filters it. */
export function textureOf({ width, height, data }) {
  const texels = new Uint16Array(4 * width * height), half = (value) => THREE.DataUtils.toHalfFloat(Math.min(65504, Math.max(0, value)));
  for (let i = 0; i < texels.length; i++) {
    const row = height - 1 - Math.floor(i / 4 / width), column = Math.floor(i / 4) % width; // rows go upwards
    texels[i] = i % 4 === 3 ? half(1) : half(data[3 * (row * width + column) + (i % 4)]);
  }
  const texture = new THREE.DataTexture(texels, width, height, THREE.RGBAFormat, THREE.HalfFloatType, THREE.EquirectangularReflectionMapping);
  return Object.assign(texture, { wrapS: THREE.RepeatWrapping, magFilter: THREE.LinearFilter, minFilter: THREE.LinearFilter, needsUpdate: true });
}
