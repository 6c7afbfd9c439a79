// Prints, as JSON, the coefficients [9][3] that three.js gets for lights [[direction, colour], …] in a file.
import { readFileSync } from "node:fs";
import { SphericalHarmonics3, Vector3 } from "three";

const sh = new SphericalHarmonics3();
const basis = [];
for (const [direction, colour] of JSON.parse(readFileSync(process.argv[2], "utf8"))) {
  SphericalHarmonics3.getBasisAt(new Vector3(...direction), basis);
  sh.coefficients.forEach((one, i) => one.addScaledVector(new Vector3(...colour), basis[i])); // as LightProbeGenerator
}
process.stdout.write(JSON.stringify(sh.coefficients.map((one) => one.toArray())));
