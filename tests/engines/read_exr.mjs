// Prints, as JSON, what the EXRLoader of three.js makes of a file: width, height and the bits of the halves, RGBA.
import { readFileSync } from "node:fs";
import { HalfFloatType } from "three";
import { EXRLoader } from "three/addons/loaders/EXRLoader.js";

const bytes = readFileSync(process.argv[2]);
const loader = new EXRLoader().setDataType(HalfFloatType);
const { width, height, data } = loader.parse(bytes.buffer.slice(bytes.byteOffset, bytes.byteOffset + bytes.length));
process.stdout.write(JSON.stringify({ width, height, data: Array.from(data) }));
