// Skies: lat-long pictures, read row by row, so that an .hdr of 8k needs little more memory than its file.
// three.js's HDRLoader is not enough: it shows a truncated file as black rows, and needs memory for all pixels.
const MOST_ROWS = 512; // of what is kept: phones must hold it, and its filtered copies

/** What went wrong with a file, in words for the person who opened it. */
export class Failure extends Error {}

/** Width, height and linear radiance [height·width·3] of a picture, .hdr or .exr, averaged to at most 512 rows of 1024 pixels. */
export async function readSky(bytes) {
  const { width: columns, height: lines, rows } = bytes[0] === 0x23 ? openHdr(bytes) : await openExr(bytes);
  const height = Math.min(lines, MOST_ROWS), width = Math.min(columns, 2 * MOST_ROWS), data = new Float32Array(3 * width * height);
  const across = Array.from({ length: columns }, (_, i) => overlaps(i, columns, width)), weights = new Float64Array(height);
  const mean = new Float64Array(3 * width);
  let number = 0;
  for (const row of rows) {
    mean.fill(0);
    across.forEach((parts, i) => {
      for (const [column, share] of parts) for (let c = 0; c < 3; c++) mean[3 * column + c] += (share * width * row[3 * i + c]) / columns;
    });
    for (const [line, share] of overlaps(number, lines, height)) {
      const weight = share * Math.sin((Math.PI * (number + 0.5)) / lines);
      weights[line] += weight;
      mean.forEach((value, i) => (data[3 * width * line + i] += weight * value));
    }
    if (++number % 128 === 0) await new Promise((done) => setTimeout(done)); // the page stays alive
  }
  if (!data.every(Number.isFinite)) throw new Failure("has pixels that are not finite; repair it, or export the page with it and --mend.");
  return { width, height, data: data.map((sum, i) => sum / weights[Math.floor(i / 3 / width)]) };
}

/** The cells of `coarse` ≤ `fine` equal ones that cell i of `fine` overlaps, at most two, each with its share of it. */
function overlaps(i, fine, coarse) {
  const cell = Math.floor((i * coarse) / fine), share = ((cell + 1) * fine - i * coarse) / coarse;
  return share < 1 ? [[cell, share], [cell + 1, 1 - share]] : [[cell, 1]];
}

function parseExr(loader, bytes) {
  try {
    return loader.parse(bytes);
  } catch (error) { // "EXRLoader.parse: …" tells what it does not read; others are of decoders that ran out of bytes
    throw /EXRLoader/.test(error.message) ? error : new Failure("is truncated or damaged; copy it again.", { cause: error });
  }
}

async function openExr(bytes) {
  const [{ EXRLoader }, { FloatType }] = await Promise.all([import("three/addons/loaders/EXRLoader.js"), import("three")]);
  const { data, width, height } = parseExr(new EXRLoader().setDataType(FloatType), bytes.buffer), channels = data.length / width / height;
  if (channels < 3) throw new Failure("has no red, green and blue.");
  return { width, height, rows: exrRows(data, width, height, channels) };
}

function* exrRows(data, width, height, channels) {
  const row = new Float32Array(3 * width);
  for (let y = height - 1; y >= 0; y--) { // the loader's rows go upwards
    for (let i = 0; i < 3 * width; i++) row[i] = data[(y * width + Math.floor(i / 3)) * channels + (i % 3)];
    yield row;
  }
}

/** Radiance files: https://radsite.lbl.gov/radiance/refer/filefmts.pdf */
function openHdr(bytes) {
  const header = new TextDecoder("latin1").decode(bytes.subarray(0, 65536)), size = /\n\n-Y (\d+) \+X (\d+)\n/.exec(header);
  if (!/\n\n[^\n]+\n/.test(header)) throw new Failure("is truncated in its header; copy it again.");
  if (!size || /FORMAT=32-bit_rle_xyze/.test(header)) throw new Failure("is stored in an unusual order or in XYZ; save it again as RGBE.");
  const [height, width] = [Number(size[1]), Number(size[2])], exposures = header.slice(0, size.index).matchAll(/EXPOSURE=\s*(\S+)/g);
  const exposure = [...exposures].reduce((all, [, one]) => all * one, 1);
  return { width, height, rows: hdrRows(bytes, size.index + size[0].length, width, height, exposure) };
}

function* hdrRows(bytes, at, width, height, exposure) {
  const row = new Float32Array(3 * width);
  let pixels = new Uint8Array(4 * width);
  for (let number = 0; number < height; number++) {
    const coded = width >= 8 && width < 32768 && bytes[at] === 2 && bytes[at + 1] === 2 && bytes[at + 2] < 128;
    if (coded) at += 4; // then each channel: runs (count + 128, value) and literals (count, values)
    else at += (pixels = bytes.slice(at, at + 4 * width)).length;
    for (let i = 0; coded && i < 4 * width; ) {
      const count = bytes[at++], end = i + (count > 128 ? count - 128 : count), value = bytes[at];
      if (!count || end > 4 * width) at = NaN;
      for (; i < end; i++) pixels[(i % width) * 4 + Math.floor(i / width)] = count > 128 ? value : bytes[at++];
      if (count > 128) at++;
      if (!(at <= bytes.length)) break;
    }
    if (!(at <= bytes.length) || pixels.length < 4 * width) throw new Failure(`is truncated in row ${number} of ${height}; copy it again.`);
    for (let i = 0; i < 3 * width; i++) {
      const pixel = 4 * Math.floor(i / 3), exponent = pixels[pixel + 3];
      row[i] = exponent ? (pixels[pixel + (i % 3)] * 2 ** (exponent - 136)) / exposure : 0;
    }
    yield row;
  }
}
