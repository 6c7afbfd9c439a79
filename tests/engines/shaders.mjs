// Runs in the browser: a vertex shader for each vertex in WebGL2, or a compute shader in WebGPU, as job.json says.

async function webgl({ shader, attributes, uniforms, block, textures, output, count }) {
  const gl = document.createElement("canvas").getContext("webgl2");
  const program = gl.createProgram();
  const fragment = "#version 300 es\nvoid main() {}";
  for (const [type, text] of [[gl.VERTEX_SHADER, shader], [gl.FRAGMENT_SHADER, fragment]]) {
    const stage = gl.createShader(type);
    gl.shaderSource(stage, text);
    gl.compileShader(stage);
    if (!gl.getShaderParameter(stage, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(stage));
    gl.attachShader(program, stage);
  }
  gl.transformFeedbackVaryings(program, [output], gl.SEPARATE_ATTRIBS);
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program));
  gl.useProgram(program);
  for (const [name, { size, values }] of Object.entries(attributes)) {
    const at = gl.getAttribLocation(program, name);
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ARRAY_BUFFER, new Float32Array(values), gl.STATIC_DRAW);
    gl.enableVertexAttribArray(at);
    gl.vertexAttribPointer(at, size, gl.FLOAT, false, 0, 0);
  }
  for (const [name, { kind, values }] of Object.entries(uniforms)) {
    const at = gl.getUniformLocation(program, name);
    if (kind.startsWith("Matrix")) gl[`uniform${kind}`](at, false, values);
    else gl[`uniform${kind}`](at, values);
  }
  if (block) { // the only one
    gl.bindBufferBase(gl.UNIFORM_BUFFER, 0, gl.createBuffer());
    gl.bufferData(gl.UNIFORM_BUFFER, new Float32Array(block), gl.STATIC_DRAW);
    gl.uniformBlockBinding(program, 0, 0);
  }
  textures.forEach(({ name, width, height, format, values }, unit) => {
    gl.activeTexture(gl.TEXTURE0 + unit);
    gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
    const half = format === "half"; // RGB as bits of halves; else RGBA as floats
    if (half) gl.pixelStorei(gl.UNPACK_ALIGNMENT, 2);
    const pixels = half ? new Uint16Array(values) : new Float32Array(values);
    const how = half ? [gl.RGB16F, gl.RGB, gl.HALF_FLOAT] : [gl.RGBA32F, gl.RGBA, gl.FLOAT];
    gl.texImage2D(gl.TEXTURE_2D, 0, how[0], width, height, 0, how[1], how[2], pixels);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
    gl.uniform1i(gl.getUniformLocation(program, name), unit);
  });
  gl.bindBuffer(gl.ARRAY_BUFFER, null);
  const results = gl.createBuffer();
  gl.bindBufferBase(gl.TRANSFORM_FEEDBACK_BUFFER, 0, results);
  gl.bufferData(gl.TRANSFORM_FEEDBACK_BUFFER, 12 * count, gl.STREAM_READ);
  gl.enable(gl.RASTERIZER_DISCARD);
  gl.beginTransformFeedback(gl.POINTS);
  gl.drawArrays(gl.POINTS, 0, count);
  gl.endTransformFeedback();
  const found = new Float32Array(3 * count);
  gl.getBufferSubData(gl.TRANSFORM_FEEDBACK_BUFFER, 0, found);
  if (gl.getError()) throw new Error(`WebGL error ${gl.getError()}`);
  return Array.from(found);
}

async function webgpu({ shader, buffers, textures, count }) {
  const device = await (await navigator.gpu.requestAdapter()).requestDevice();
  device.addEventListener("uncapturederror", ({ error }) => console.error(error.message));
  const { STORAGE, COPY_SRC, COPY_DST, MAP_READ } = GPUBufferUsage;
  const buffer = (values) => {
    const bytes = new Float32Array(values);
    const made = device.createBuffer({ size: bytes.byteLength, usage: STORAGE | COPY_DST });
    device.queue.writeBuffer(made, 0, bytes);
    return { buffer: made };
  };
  const texture = ({ width, height, values }) => {
    const usage = GPUTextureUsage.TEXTURE_BINDING | GPUTextureUsage.COPY_DST;
    const made = device.createTexture({ size: [width, height], format: "rgba16float", usage });
    device.queue.writeTexture({ texture: made }, new Uint16Array(values), { bytesPerRow: 8 * width }, [width, height]);
    return made.createView();
  };
  const size = 16 * count; // of vec3f in an array
  const results = device.createBuffer({ size, usage: STORAGE | COPY_SRC });
  const readable = device.createBuffer({ size, usage: MAP_READ | COPY_DST });
  const module = device.createShaderModule({ code: shader });
  const errors = (await module.getCompilationInfo()).messages;
  if (errors.length) throw new Error(errors.map(({ lineNum, message }) => `${lineNum}: ${message}`).join("\n"));
  const pipeline = device.createComputePipeline({ layout: "auto", compute: { module } });
  const resources = [{ buffer: results }, ...buffers.map(buffer), ...textures.map(texture)];
  const entries = resources.map((resource, binding) => ({ binding, resource }));
  const encoder = device.createCommandEncoder();
  const pass = encoder.beginComputePass();
  pass.setPipeline(pipeline);
  pass.setBindGroup(0, device.createBindGroup({ layout: pipeline.getBindGroupLayout(0), entries }));
  pass.dispatchWorkgroups(count);
  pass.end();
  encoder.copyBufferToBuffer(results, 0, readable, 0, size);
  device.queue.submit([encoder.finish()]);
  await readable.mapAsync(GPUMapMode.READ);
  return Array.from(new Float32Array(readable.getMappedRange())).filter((_, i) => i % 4 < 3);
}

const jobs = await (await fetch("jobs.json")).json();
const found = [];
for (const job of jobs) found.push(await (job.buffers ? webgpu(job) : webgl(job)));
window.result = found;
